# fusibile takes every folder in results/ whose name is 2..._..._IMAGE. So these are maps of this plan only: those of others move to older/, and
# back when a plan asks for them again.
mkdir -p results older || exit 1
for result in results/*; do
    [ -e "$result" ] || continue
    rm -rf "older/${result#results/}"
    mv "$result" older/ || exit 1
done
back() {
    [ ! -d "older/$1" ] || mv "older/$1" results/
}
# gipuma names its folder by the time and the key view: RESULT KEY.jpg PARTNER.jpg... OPTIONS. A result of before comes back from older/ where the
# script is killed between the two moves.
map() {
    result=results/$1 before=older/$1
    shift
    rm -rf scratch
    mkdir scratch && gipuma "$@" -output_folder scratch/ || return 1
    for made in scratch/*_"${1%.jpg}"; do
        [ -s "$made/disp.dmb" ] && [ -s "$made/normals.dmb" ] || continue
        [ ! -d "$result" ] || mv "$result" "$before" || return 1
        mv "$made" "$result" && rm -rf "$before" && return
    done
    return 1
}
