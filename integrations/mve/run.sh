#!/bin/sh
# Computes the depth maps of viewrank's plan with MVE, in rank order, and joins them. dmrecon and scene2pset are on the PATH.
# Started again, it goes on. It keeps maps that were made otherwise, and measures none: `viewrank run PROJECT` does the rest, and goes on from its maps.
set -u
@RESTART@
@REFUSE_STRANGERS@
# What a killed viewrank run left is in nobody's way.
refuse_strangers links.txt . -path ./unfinished -prune -o
own_files .
alone .
kept=0 failed=0
tried mkdir -p done || exit 1
# MVE opens no scene with a view that has no meta.ini, as an older plan may leave it.
for view in views/*.mve; do
    [ -f "$view/meta.ini" ] || tried mv "$view" "${view%.mve}.older.$$" || exit 1
done
# Puts a line into a new file: NAME LINE
mark() {
    tried rm -f "done/$1" && printf '%s\n' "$2" > "done/$1"
}
# Computes a depth map unless it is there: MARK ID MAP BUNDLE OPTIONS. dmrecon passes over a view that has one, also what a killed run has cut off.
map() {
    made=$(head -c 16 "done/$1" 2>/dev/null | LC_ALL=C tr -c '0-9a-z' '?')
    name=$1 id=$2 map=$3 bundle=$4
    shift 4
    if [ -s "$map" ] && [ "$made" = "$id" ]; then
        return
    fi
    if [ -s "$map" ] && [ -z "$made" ]; then
        kept=$((kept + 1)) last=$map
        return
    fi
    mark "$name" unfinished && tried rm -f "$map" synth_0.out && tried cp "$bundle" synth_0.out && dmrecon "$@" . && [ -s "$map" ] && mark "$name" "$id" || {
        say "error: $map failed" >&2
        failed=1
    }
}
# Joins maps of one size: CLOUD OPTIONS
join() {
    cloud=$1
    shift
    tried rm -f unfinished.ply && scene2pset "$@" . unfinished.ply && tried mv -f unfinished.ply "$cloud" || {
        say "error: $cloud failed" >&2
        failed=1
    }
}
@MAPS@
[ "$kept" -eq 0 ] || say "$kept depth maps were made otherwise, or nobody knows how, and are kept, such as $last: remove them to compute them again" >&2
@FUSION@
exit "$failed"
