#!/bin/sh
# Computes the depth maps of viewrank's plan, in rank order, and joins them. Started again, it goes on.
# It keeps maps that were made otherwise, and measures none: `viewrank run PROJECT` does the rest, and goes on from its maps.
set -u
@RESTART@
@REFUSE_STRANGERS@
# What a killed viewrank run left is in nobody's way.
refuse_strangers . -path ./unfinished -prune -o << 'LINKS' || exit 1
@LINKS@
LINKS
alone .
own_files .
kept=0 failed=0
tried mkdir -p done || exit 1
fail() {
    say "error: $1 failed" >&2
    failed=1
}
@STEPS@
# Computes a depth map unless it is there: MARK ID MAP WORDS for `compute`. What a killed run has cut off is not.
map() {
    made=$(head -c 16 "done/$1" 2>/dev/null | LC_ALL=C tr -c '0-9a-z' '?')
    name=$1 id=$2 map=$3
    shift 3
    if [ -s "$map" ] && [ "$made" = "$id" ]; then
        return
    fi
    if [ -s "$map" ] && [ -z "$made" ]; then
        kept=$((kept + 1)) last=$map
        return
    fi
    mark "$name" unfinished && tried rm -f "$map" && compute "$@" && [ -s "$map" ] && mark "$name" "$id" || fail "$map"
}
@MAPS@
[ "$kept" -eq 0 ] || say "$kept depth maps were made otherwise, or nobody knows how, and are kept, such as $last: remove them to compute them again" >&2
@JOINING@
exit "$failed"
