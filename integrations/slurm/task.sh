#!/bin/sh
# Computes the depth map of one view cluster of viewrank's plan: task.sh RANK, or in a job array: task.sh array OFFSET.
# Leaves at once when the map is there or the target is reached, so that it may be started any number of times.
@ABSOLUTE_PATH@
# sh names the script in its own messages, and the folders above it may have a stranger's names: it is started again as a name of our own. A copy of a queue's has one.
case $0 in
.//task.sh) ;;
*/task.sh)
    unset CDPATH
    cd -- "${0%/*}/" && exec sh .//task.sh "$@"
    exit 1
    ;;
esac
@HEAD@
set -u
@REFUSE_STRANGERS@
@LIST@
refuse_strangers /dev/null "$folder"
case ${1:-} in
array) rank=$((${2:-0} + ${SLURM_ARRAY_TASK_ID:?is set by the queue})) ;;
'' | *[!0-9]*)
    echo 'usage: task.sh RANK' >&2
    exit 2
    ;;
*) rank=$1 ;;
esac

reached() {
    [ ! -L "$project/viewrank/progress.json" ] || refuse "$project/viewrank/progress.json"
    [ -f "$project/viewrank/progress.json" ] && refuse_long "$project/viewrank/progress.json" && grep -Eq '"target_reached": *true' "$project/viewrank/progress.json"
}
# The tasks of this array that wait are not needed any more.
stop() {
    echo 'the target is reached'
    [ -z "${SLURM_ARRAY_JOB_ID:-}" ] || scancel --state=PENDING "$SLURM_ARRAY_JOB_ID"
}
if reached; then
    stop
    exit 0
fi

refuse_forged_list
tab=$(printf '\t')
IFS=$tab read -r _ marker id map key <<EOF
$(awk -F '\t' -v rank="$rank" '$1 == rank' "$list")
EOF
if [ -z "$map" ]; then
    say "rank $rank: no depth map can be made"
    exit 0
fi
marker=$folder/done/$marker
if [ -s "$map" ] && { [ "$rank" -le "$finished" ] || [ "$(noted "$marker")" = "$id" ]; }; then
    say "rank $rank: $key is there"
    exit 0
fi
tried mkdir -p "$folder/done" && tried rm -f "$marker" || exit 1
say "rank $rank: $key on $(uname -n)"
if ! compute || [ ! -s "$map" ]; then
    say "rank $rank: $key failed" >&2
    exit 1
fi
draft=$marker.$(uname -n).$$
tried rm -f "$draft" && printf '%s\n' "$id" > "$draft" && tried mv -f "$draft" "$marker" || exit 1
if reached; then
    stop
fi
exit 0
