# All maps in depthMaps/ are joined.
tried mkdir -p kept depthMaps || exit 1
for map in depthMaps/*; do
    id=${map#depthMaps/}
    [ ! -e "$map" ] || withdraw "$map" "${id%%_*}"
done
for name in $results; do
    [ ! -d "kept/$name" ] || present "$name" depthMaps
done
# Computes the maps of a key view: NAME OPTIONS
map() {
    name=$1
    shift
    tried rm -rf unfinished
    mkdir unfinished && aliceVision_depthMapEstimation "$@" -o unfinished || return 1
    [ -e "unfinished/${name%-*}_depthMap.exr" ] && move unfinished "kept/$name" && present "$name" depthMaps
}
# Joins the maps that exist: OPTIONS of the filtering. It writes to an empty folder, since AliceVision takes what it finds there for its own, and
# what was joined before stays until the new result is complete.
join() {
    tried rm -rf unfinished
    mkdir unfinished unfinished/filtered unfinished/joined || return 1
    python3 -I finished.py &&
        aliceVision_depthMapFiltering -i finished.sfm --depthMapsFolder depthMaps -o unfinished/filtered "$@" &&
        aliceVision_meshing -i finished.sfm --depthMapsFolder unfinished/filtered --output unfinished/joined/dense.abc \
            --outputMesh unfinished/joined/mesh.obj || return 1
    tried rm -rf filtered && tried mv -f unfinished/filtered filtered && tried mv -f unfinished/joined/* .
}
