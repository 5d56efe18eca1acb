mkdir -p depthMaps older || exit 1
# depthMaps/ holds maps of this plan only, since all of them are joined. Those of other plans are in older/, and come back when a plan asks for them
# again: NAME RECIPE
set_aside() {
    ls "depthMaps/${name}_"* >/dev/null 2>&1 || return 0
    kept=older/$name-$(cat "done/$name" 2>/dev/null)
    rm -rf "$kept"
    mkdir "$kept" && mv "depthMaps/${name}_"* "$kept" || exit 1
}
back() {
    name=$1
    [ -d "older/$1-$2" ] && [ "$(cat "done/$1" 2>/dev/null)" != "$2" ] || return 0
    set_aside
    mv "older/$1-$2"/* depthMaps/ && rmdir "older/$1-$2" && mkdir -p done && echo "$2" >"done/$1"
}
# The maps of a key view, in depthMaps/ once they are all there: ID OPTIONS
map() {
    id=$1
    shift
    rm -rf depthMaps.new
    mkdir depthMaps.new && aliceVision_depthMapEstimation "$@" -o depthMaps.new || return 1
    [ -e "depthMaps.new/${id}_depthMap.exr" ] && mv depthMaps.new/* depthMaps/ && rmdir depthMaps.new
}
# Joins the maps that exist: OPTIONS of the filtering. It writes to an empty folder, since AliceVision takes what it finds there for its own, and
# what was joined before stays until the new result is complete.
join() {
    python3 finished.py || return 1
    rm -rf filtered.new joined.new
    mkdir filtered.new joined.new &&
        aliceVision_depthMapFiltering -i finished.sfm --depthMapsFolder depthMaps -o filtered.new "$@" &&
        aliceVision_meshing -i finished.sfm --depthMapsFolder filtered.new --output joined.new/dense.abc --outputMesh joined.new/mesh.obj || return 1
    rm -rf filtered
    mv filtered.new filtered && mv joined.new/* . && rmdir joined.new
}
