# fusibile takes every folder in results/ whose name is 2..._..._IMAGE, so only those of this plan stay there.
result="2_${recipe}_*"
only results "$results"
# Computes the map of a key view: NAME KEY.jpg PARTNER.jpg... OPTIONS. gipuma names its folder by the time and the key view.
map() {
    name=$1
    shift
    tried rm -rf unfinished
    mkdir unfinished && gipuma "$@" -output_folder unfinished/ || return 1
    made=$(echo unfinished/*_"${1%.jpg}")
    [ -s "$made/disp.dmb" ] && [ -s "$made/normals.dmb" ] && move "$made" "results/$name"
}
