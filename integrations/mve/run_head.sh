# dmrecon skips a view that has a map, and scene2pset joins all maps that the views have.
tried mkdir -p kept || exit 1
map_names='*-L*'
for view in views/*.mve; do
    name=${view#views/}
    for map in "$view"/*-L*; do
        [ ! -e "$map" ] || withdraw "$map" "${name%.mve}"
    done
    # MVE opens no scene with a view that has no meta.ini, as an older plan may leave it.
    [ -f "$view/meta.ini" ] || rmdir "$view" 2>/dev/null || put_aside "$view"
done
own_files .
for name in $results; do
    [ ! -d "kept/$name" ] || present "$name" "views/${name%-*}.mve"
done
# Computes the map of a key view: NAME BUNDLE OPTIONS
map() {
    name=$1 view=views/${1%-*}.mve bundle=bundles/$2
    shift 2
    tried rm -rf synth_0.out unfinished
    tried cp "$bundle" synth_0.out && dmrecon "$@" . && ls "$view"/depth-L*.mvei >/dev/null 2>&1 && mkdir unfinished &&
        tried mv -f "$view"/*-L* unfinished && move unfinished "kept/$name" && present "$name" "$view"
}
