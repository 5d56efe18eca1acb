# dmrecon skips a view that has a map, and scene2pset joins all maps that the views have. So the views get their maps from kept/NAME-RECIPE/, where they
# are added when they are finished; those of other plans stay there.
mkdir -p kept || exit 1
for view in views/*.mve; do
    rm -f "$view"/*-L*
    # MVE opens no scene with a view that has no meta.ini, as an older plan may leave it.
    [ -f "$view/meta.ini" ] || rmdir "$view" || exit 1
done
for name in $results; do
    [ ! -d "kept/$name" ] || ln "kept/$name"/* "views/${name%-*}.mve" 2>/dev/null || cp -p "kept/$name"/* "views/${name%-*}.mve" || exit 1
done
# Computes the map of a key view: NAME BUNDLE OPTIONS
map() {
    name=$1 view=views/${1%-*}.mve bundle=bundles/$2
    shift 2
    rm -rf "$view"/*-L* synth_0.out unfinished
    cp "$bundle" synth_0.out && dmrecon "$@" . && ls "$view"/depth-L*.mvei >/dev/null && mkdir unfinished || return 1
    ln "$view"/*-L* unfinished 2>/dev/null || cp -p "$view"/*-L* unfinished || return 1
    move unfinished "kept/$name"
}
