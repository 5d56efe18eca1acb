# MVE opens no scene with a view that has no meta.ini, as an older plan may leave it.
for view in views/*.mve; do
    [ -f "$view/meta.ini" ] || tried mv "$view" "${view%.mve}.older.$$" || exit 1
done
# BUNDLE OPTIONS of dmrecon, which chooses partners by the features in synth_0.out.
compute() {
    tried rm -f synth_0.out && tried cp "$1" synth_0.out || return 1
    shift
    dmrecon "$@" .
}
# Joins maps of one size: CLOUD OPTIONS
join() {
    cloud=$1
    shift
    tried rm -f unfinished.ply && scene2pset "$@" . unfinished.ply && tried mv -f unfinished.ply "$cloud" || fail "$cloud"
}
