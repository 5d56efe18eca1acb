# fusibile takes every folder in results/ whose name is 2..._..._IMAGE. So these are maps of this plan only: those of others move to older/, and
# back when a plan asks for them again.
mkdir -p results older || exit 1
for result in results/*; do
    [ ! -e "$result" ] || mv "$result" older/ || exit 1
done
back() {
    [ ! -d "older/$1" ] || mv "older/$1" results/
}
# gipuma names its folder by the time and the key view: RESULT KEY.jpg PARTNER.jpg... OPTIONS
map() {
    result=results/$1
    shift
    rm -rf scratch
    mkdir scratch && gipuma "$@" -output_folder scratch/ || return 1
    for made in scratch/*_"${1%.jpg}"; do
        [ -s "$made/disp.dmb" ] && [ -s "$made/normals.dmb" ] && rm -rf "$result" && mv "$made" "$result" && return
    done
    return 1
}
