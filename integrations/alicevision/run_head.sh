# maps/ID-RECIPE/ holds the maps of a key view.
result='*-????????????????'
only maps "$results"
# Computes the maps of a key view: NAME OPTIONS
map() {
    name=$1
    shift
    rm -rf unfinished
    mkdir unfinished && aliceVision_depthMapEstimation "$@" -o unfinished &&
        [ -e "unfinished/${name%-*}_depthMap.exr" ] && move unfinished "maps/$name"
}
# Joins the maps that exist: OPTIONS of the filtering. It writes to an empty folder, since AliceVision takes what it finds there for its own, and
# what was joined before stays until the new result is complete.
join() {
    rm -rf unfinished
    mkdir unfinished unfinished/maps unfinished/filtered unfinished/joined || return 1
    for name in $results; do
        [ ! -d "maps/$name" ] || ln "maps/$name"/* unfinished/maps 2>/dev/null || cp "maps/$name"/* unfinished/maps || return 1
    done
    python3 finished.py unfinished/maps &&
        aliceVision_depthMapFiltering -i finished.sfm --depthMapsFolder unfinished/maps -o unfinished/filtered "$@" &&
        aliceVision_meshing -i finished.sfm --depthMapsFolder unfinished/filtered --output unfinished/joined/dense.abc \
            --outputMesh unfinished/joined/mesh.obj && mv unfinished/joined/* .
}
