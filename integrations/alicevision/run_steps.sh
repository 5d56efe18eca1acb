# SCENE OPTIONS
compute() {
    scene=$1
    shift
    aliceVision_depthMapEstimation -i "$scene" --imagesFolder images -o depthMaps "$@"
}
# Joins the maps, if all are there: OPTIONS of the filtering, which takes what it finds in its output folder for its own.
join() {
    [ "$failed" -eq 0 ] || return
    new=$(tried mktemp -d joining.XXXXXX) && mkdir "$new/filtered" &&
        aliceVision_depthMapFiltering -i keys.sfm --depthMapsFolder depthMaps -o "$new/filtered" "$@" &&
        aliceVision_meshing -i keys.sfm --depthMapsFolder "$new/filtered" --output "$new/dense.abc" --outputMesh "$new/mesh.obj" &&
        tried mv -f "$new/dense.abc" "$new/mesh.obj" . || fail "the fusion"
    tried rm -rf "$new"
}
