#!/bin/sh
# Computes viewrank's plan, one view cluster after the other in rank order, and joins what came out. A cluster that fails keeps no others from being
# tried; one that is finished stays: done/NAME says what it was made of (without that file it is made anew). Exit code 1: something failed.
set -u
cd "$(dirname "$0")" || exit 1
failed=0
fail() {
    echo "error: $1 failed" >&2
    failed=1
}
# What becomes of the result of another recipe before its mark goes.
set_aside() { :; }
# Is the cluster still to be computed? NAME RECIPE RESULT: a word for all that it is made of, and a file that it leaves.
begin() {
    name=$1 recipe=$2
    if [ -e "$3" ] && [ "$(cat "done/$name" 2>/dev/null)" = "$recipe" ]; then
        return 1
    fi
    set_aside
    rm -f "done/$name"
}
# What became of it: the exit status of its commands.
end() {
    if [ "$1" -eq 0 ] && mkdir -p done; then
        echo "$recipe" >"done/$name"
    else
        fail "$name"
    fi
}
