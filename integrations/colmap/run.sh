#!/bin/sh
# Computes the depth maps of viewrank's plan with COLMAP, in rank order, and fuses them. COLMAP=/path/to/colmap run.sh takes another program.
# Started again, it goes on. It keeps maps that were made otherwise, measures none, and fuses only the whole list: `viewrank run PROJECT` does the rest, and goes on from its maps.
set -eu
if [ $# -gt 0 ]; then
    echo "error: run.sh takes no options: viewrank run has --rank and --fuse, and makes maps of earlier plans anew" >&2
    exit 2
fi
@RESTART@
cd ../..
@REFUSE_STRANGERS@
# What a killed viewrank run left is in nobody's way. The folder of pictures may be a link.
refuse_strangers stereo sparse -path stereo/viewrank/unfinished -prune -o < /dev/null
refuse_no_files -H images
# The lists name files below the folders of maps: no path in them may lead out of these. A mark is a hash. Each mark takes a few processes, so there are no more than the plan has.
marks=stereo/viewrank/marks.tsv
for list in "$marks" stereo/patch-match.cfg stereo/viewrank/*.cfg; do
    # Tools read on at a NUL in different ways.
    [ ! -f "$list" ] || { refuse_long "$list" && [ "$(LC_ALL=C tr -d '\t\n\040-\176\200-\377' < "$list" | head -c 1 | wc -c)" -eq 0 ] && LC_ALL=C awk -v marks="$marks" '
        { path = $0 }
        FILENAME == marks { wrong = NR > @LINES@ || !sub(/^[0-9a-f]+\t[0-9a-f]+\t/, "", path) || path == "" }
        wrong || path ~ /(^|,)[ \t]*(\/|\.\.(\/|$))|\/\.\.(\/|$)/ { exit 1 }' "$list" 2>/dev/null; } || refuse "$list"
done
# Another run.sh would remove maps that this one is writing. What COLMAP itself holds open keeps the lock as long as it computes.
alone stereo/viewrank
# A map of COLMAP is whole when its size is what its head says: WIDTH&HEIGHT&CHANNELS& and as many floats.
whole() {
    [ -f "$1" ] || return 1
    head=$(head -c 40 -- "$1" 2>/dev/null | LC_ALL=C tr -c '0-9&' ' ')
    width=${head%%&*} rest=${head#*&}
    height=${rest%%&*} rest=${rest#*&}
    channels=${rest%%&*}
    for number in "$width" "$height" "$channels"; do
        case $number in '' | 0* | *[!0-9]* | ??????????*) return 1 ;; esac
    done
    [ "$(wc -c < "$1")" -eq $((${#width} + ${#height} + ${#channels} + 3 + 4 * width * height * channels)) ]
}
# COLMAP keeps what is there, also what a killed run has cut off. A map counts as made from its list when it is whole and has its mark.
kept=0
tried mkdir -p stereo/viewrank/done
while IFS=$(printf '\t') read -r mark id map; do
    mark=stereo/viewrank/done/$mark
    if ! whole "stereo/depth_maps/$map" || ! whole "stereo/normal_maps/$map"; then
        tried rm -f -- "$mark" "stereo/depth_maps/$map" "stereo/normal_maps/$map"
        echo "$id" > "$mark"
    elif [ "$(head -c 16 -- "$mark" 2>/dev/null | LC_ALL=C tr -c '0-9a-f' '?')" != "$id" ]; then
        kept=$((kept + 1)) last=$map
    fi
done < "$marks"
@MAPS@
[ "$kept" -eq 0 ] || say "$kept depth maps were made otherwise, or nobody knows how, and are kept, such as $last: remove them to compute them again" >&2
# A new file: an older one may have another name elsewhere.
rm -f stereo/viewrank/unfinished.ply stereo/viewrank/unfinished.ply.vis
@FUSION@
[ ! -f stereo/viewrank/unfinished.ply.vis ] || mv stereo/viewrank/unfinished.ply.vis stereo/viewrank/fused.ply.vis
mv stereo/viewrank/unfinished.ply stereo/viewrank/fused.ply
