#!/bin/sh
# Computes and fuses the depth maps of viewrank's plan. COLMAP=/path/to/colmap run.sh takes another program.
usage='usage: run.sh             the depth maps that are not there yet, and the fusion
       run.sh --replace   the same, and maps that were made with other partners or options are made anew
       run.sh --rank N    the depth map of the N-th key view alone, made anew unless it is there, whole and of this plan; for queues
       run.sh --fuse      the fusion alone'
set -eu
case $#${1:-} in
0 | 1--replace | 1--fuse | 2--rank) ;;
1--help | 1-h)
    echo "$usage"
    exit 0
    ;;
*)
    echo "error: run.sh $*" >&2
    echo "$usage" >&2
    exit 2
    ;;
esac
@ABSOLUTE_PATH@
# sh names the script in its own messages, and the folders above it may have a stranger's names: it is started again as a name of our own.
case $0 in
.//stereo/viewrank/run.sh) ;;
*)
    unset CDPATH
    case $0 in */*) here=${0%/*}/ ;; *) here=./ ;; esac
    cd -- "$here../.." && exec sh .//stereo/viewrank/run.sh "$@"
    exit 1
    ;;
esac
@REFUSE_STRANGERS@
refuse_strangers /dev/null stereo sparse
# The folder of pictures may be a link, too.
refuse_no_files -H images
maps=stereo/viewrank/maps.tsv
tab=$(printf '\t')
# The lists name files below the folders of maps. A path in them may not lead out of these, and what a map was made by is a hash.
refuse_paths_out() {
    found=$(LC_ALL=C awk -F '\t' -v maps="$maps" '
        BEGIN { hash = "[0-9a-f]"; hash = hash hash hash hash; hash = "^(" hash hash hash hash "|[?-])$" }
        { path = $0 }
        FILENAME == maps { wrong = $1 !~ hash || $2 !~ hash || !sub(/^[^\t]*\t[^\t]*\t/, "", path) }
        wrong || path == "" && FILENAME == maps || path ~ /^\// || path ~ /(^|\/|, )\.\.(\/|$)/ { print FILENAME; exit }' "$1" 2>/dev/null) || [ ! -e "$1" ] || refuse "$1" # gone: another cluster's, which is done
    [ -z "$found" ] || refuse "$found"
}
for list in "$maps" stereo/patch-match.cfg stereo/viewrank/*.cfg stereo/viewrank/*.txt; do
    [ ! -f "$list" ] || { refuse_long "$list" && refuse_paths_out "$list"; }
done
# Prints what a map was made by, as a note says that may be anybody's: FILE
noted() {
    made=$(head -c 20 -- "$1" 2>/dev/null | LC_ALL=C tr -c '0-9a-f\n' '?')
    case "${#made} $made" in
    '16 '*[!0-9a-f]*) made='?' ;;
    '16 '*) ;;
    *) made='?' ;;
    esac
    echo "$made"
}

# A map of COLMAP is whole when its size is what its head says: WIDTH&HEIGHT&CHANNELS& and as many floats.
whole() {
    [ -f "$1" ] || return 1
    head=$(head -c 40 -- "$1" 2>/dev/null | LC_ALL=C tr -c '0-9&' ' ')
    width=${head%%&*} rest=${head#*&}
    height=${rest%%&*} rest=${rest#*&}
    channels=${rest%%&*}
    case $width$height$channels in '' | *[!0-9]*) return 1 ;; esac
    [ "$(wc -c < "$1")" -eq $((${#width} + ${#height} + ${#channels} + 3 + 4 * width * height * channels)) ]
}
there() {
    whole "stereo/depth_maps/$1" && whole "stereo/normal_maps/$1"
}
# Writes a line to a new file, so that no other name of an older file gets it: LINE FILE
note() {
    tried rm -f -- "$2"
    { printf '%s\n' "$1" > "$2"; } 2>/dev/null || {
        say "error: cannot write $2" >&2
        exit 1
    }
}
remove() {
    tried rm -f -- "stereo/depth_maps/$1" "stereo/depth_maps/$1.made" "stereo/normal_maps/$1" "stereo/consistency_graphs/$1"
}
# Sets maps aside that were made otherwise than the plan wants, each with its note. Lines of maps.tsv: what is wanted, what the map was made by
# when these lists were written, the map. The note beside a map, of the run that made it, says more than that line; a map without either is by
# these lists.
set_aside() {
    while IFS=$tab read -r wanted made map; do
        [ ! -f "stereo/depth_maps/$map.made" ] || made=$(noted "stereo/depth_maps/$map.made")
        case $wanted in -) continue ;; esac
        case $made in - | "$wanted") continue ;; esac
        there "$map" || continue
        note "$made" "stereo/depth_maps/$map.made"
        for file in "depth_maps/$map" "depth_maps/$map.made" "normal_maps/$map" "consistency_graphs/$map"; do
            [ ! -f "stereo/$file" ] || tried mv -f -- "stereo/$file" "stereo/$file.before"
        done
    done
}
# A map that was set aside goes when its successor is whole, and comes back where there is none. The depth map is the first both ways: so what a
# killed run left half-way is never whole. A file that no run has noted is somebody's own, and stays.
bring_back() {
    whole=0 noted=0
    [ ! -f "stereo/depth_maps/$1.made" ] || noted=1
    ! there "$1" || whole=1
    for file in "depth_maps/$1" "depth_maps/$1.made" "normal_maps/$1" "consistency_graphs/$1"; do
        [ -f "stereo/$file.before" ] || continue
        if [ "$whole" -eq 1 ]; then
            tried rm -f -- "stereo/$file.before"
        elif [ "$noted" -eq 1 ] || [ ! -e "stereo/$file" ]; then
            tried mv -f -- "stereo/$file.before" "stereo/$file"
        fi
    done
}
bring_all_back() {
    while IFS=$tab read -r wanted made map; do bring_back "$map"; done < "$maps"
}
# Lines of maps.tsv about the maps of a list: LIST KIND.
lines_of() {
    awk -v kind="$2" '
        FNR == NR { map = $0; sub(/^[^\t]*\t[^\t]*\t/, "", map); line[map] = $0; next }
        /^#/ { next }
        ++n % 2 { map = $0 "." kind ".bin"; if (map in line) print line[map] }' "$maps" "$1"
}
# The depth maps of a list: LIST OPTIONS. Each that is to be made gets its note first: a plan that is written meanwhile changes maps.tsv,
# but not what COLMAP is computing. What a killed run left is not whole, and COLMAP would keep it.
compute() {
    list=$1
    shift
    kind=photometric
    case " $* " in *" --PatchMatchStereo.geom_consistency 1 "*) kind=geometric ;; esac
    lines_of "$list" "$kind" | while IFS=$tab read -r wanted made map; do
        if ! there "$map"; then
            remove "$map"
            note "$wanted" "stereo/depth_maps/$map.made"
        fi
    done
    "${COLMAP:-colmap}" patch_match_stereo --workspace_path . --config_path "$list" "$@"
}
