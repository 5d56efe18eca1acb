mkdir -p older || exit 1
# Finished maps of another recipe are kept in older/ until others are made, since scene2pset joins what is in the view.
set_aside() {
    view=views/$name.mve kept=older/$name.maps
    [ -f "done/$name" ] && ls "$view"/*-L* >/dev/null 2>&1 || return 0
    rm -rf "$kept.part"
    mkdir "$kept.part" && cp "$view"/*-L* "$kept.part" && cp "done/$name" "$kept.part/recipe" || exit 1
    rm -rf "$kept"
    mv "$kept.part" "$kept" || exit 1
}
# Kept maps that the plan asks for again: NAME RECIPE
back() {
    view=views/$1.mve kept=older/$1.maps
    [ "$(cat "$kept/recipe" 2>/dev/null)" = "$2" ] || return 0
    rm -f "$view"/*-L*
    mkdir -p done && cp "$kept"/*-L* "$view" && cp "$kept/recipe" "done/$1" && rm -rf "$kept"
}
# Maps of views that are no key views now.
for view in views/*.mve; do
    name=${view#views/} name=${name%.mve}
    case " $keys " in
    *" $name "*) continue ;;
    esac
    if [ -f "done/$name" ]; then
        set_aside
        rm -f "$view"/*-L* "done/$name"
    fi
done
# What an older plan left has no meta.ini, without which MVE opens no scene.
for view in views/*.mve; do
    if [ ! -f "$view/meta.ini" ]; then
        rm -rf "older/${view#views/}"
        mv "$view" older/ || exit 1
    fi
done
# The depth map of a key view, not the one of before: FOLDER BUNDLE OPTIONS
map() {
    view=views/$1 bundle=bundles/$2 kept=older/${1%.mve}.maps
    shift 2
    rm -f "$view"/*-L*
    cp "$bundle" synth_0.out && dmrecon "$@" . && ls "$view"/depth-L*.mvei >/dev/null && rm -rf "$kept"
}
