# What an older plan left has no meta.ini, without which MVE opens no scene.
mkdir -p older || exit 1
for view in views/*.mve; do
    if [ ! -f "$view/meta.ini" ]; then
        rm -rf "older/${view#views/}"
        mv "$view" older/ || exit 1
    fi
done
# The depth map of a key view, not the one of before: FOLDER BUNDLE OPTIONS
map() {
    view=views/$1 bundle=bundles/$2
    shift 2
    rm -f "$view"/*-L*
    cp "$bundle" synth_0.out && dmrecon "$@" . && ls "$view"/depth-L*.mvei >/dev/null
}
