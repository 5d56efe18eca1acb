# MVE opens no scene with a view that has no meta.ini, as an older plan may leave it. Its maps come back with it.
for view in views/*.mve; do
    older=${view%.mve}.older
    [ ! -e "$older" ] || older=$older.$$
    [ -f "$view/meta.ini" ] || tried mv "$view" "$older" || exit 1
done
for older in views/*.older; do
    view=${older%.older}.mve
    if [ -d "$older" ] && [ -f "$view/meta.ini" ]; then
        for map in "$older"/*-L*; do
            [ ! -f "$map" ] || [ -e "$view/${map##*/}" ] || tried mv "$map" "$view" || exit 1
        done
        rmdir "$older" 2>/dev/null || :
    fi
done
# BUNDLE OPTIONS of dmrecon, which chooses partners by the features in synth_0.out, and ends with 0 for a map without a depth, all zeros.
compute() {
    tried rm -f synth_0.out && tried cp "$1" synth_0.out || return 1
    shift
    dmrecon "$@" . && [ "$(tail -c +28 "$map" | LC_ALL=C tr -d '\000' | head -c 1 | wc -c)" -eq 1 ]
}
# Joins maps of one size: CLOUD OPTIONS. scene2pset ends with 0 without any.
join() {
    cloud=$1
    shift
    tried rm -f unfinished.ply && scene2pset "$@" . unfinished.ply && head -n 20 unfinished.ply | LC_ALL=C grep -aq '^element vertex [1-9]' &&
        [ ! -d "$cloud" ] && tried mv -f unfinished.ply "$cloud" || fail "$cloud"
}
