#!/bin/sh
# Computes viewrank's plan cluster by cluster in rank order, and joins the results. The run goes on after a failed cluster and skips finished ones:
# done/NAME holds a hash of their inputs; without that file a cluster is computed again. Exit code 1: something failed.
set -u
cd "$(dirname "$0")" || exit 1
failed=0
fail() {
    echo "error: $1 failed" >&2
    failed=1
}
# Saves the result of another recipe before its mark is removed.
set_aside() { :; }
# Succeeds if the cluster must be computed: NAME RECIPE RESULT (a hash of its inputs, and a file that it leaves).
begin() {
    name=$1 recipe=$2
    if [ -e "$3" ] && [ "$(cat "done/$name" 2>/dev/null)" = "$recipe" ]; then
        return 1
    fi
    set_aside
    rm -f "done/$name"
}
# Marks the cluster as finished if its commands succeeded: STATUS
end() {
    if [ "$1" -eq 0 ] && mkdir -p done; then
        echo "$recipe" >"done/$name"
    else
        fail "$name"
    fi
}
