#!/bin/sh
# Computes the depth maps of viewrank's plan, in rank order, and joins them; started again, it begins anew. `viewrank run PROJECT` does the rest: it
# computes what is missing, checks each map, and joins those that are finished, of two sizes as well.
set -eu
@RESTART@
@REFUSE_STRANGERS@
# What a killed viewrank run left is in nobody's way.
refuse_strangers . -path ./unfinished -prune -o << 'LINKS'
@LINKS@
LINKS
alone .
own_files .
tried mkdir -p done
# Says what a depth map is made from: NAME LINE
mark() {
    draft=$(tried mktemp done/XXXXXX) && printf '%s\n' "$2" > "$draft" && tried mv -f "$draft" "done/$1"
}
