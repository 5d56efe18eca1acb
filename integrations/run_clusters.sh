#!/bin/sh
# Computes viewrank's plan cluster by cluster in rank order, and joins the results. The run goes on after a failed cluster and skips finished ones. Results
# carry a hash of their inputs, so those of another plan are not mistaken for these. Exit code 1: something failed.
set -u
@RESTART@
@REFUSE_STRANGERS@
refuse_strangers . << 'LINKS' || exit 1
@LINKS@
LINKS
tried mkdir -p older || exit 1
failed=0
fail() {
    say "error: $1 failed" >&2
    failed=1
}
# Matches the hash at the end of a result's name.
recipe='[0-9a-f]'
recipe=$recipe$recipe$recipe$recipe
recipe=$recipe$recipe$recipe$recipe
# Gives a result its name: FROM TO. Where that is taken, somebody has changed this folder.
move() {
    if [ -e "$2" ] || [ -L "$2" ]; then
        refuse "$2"
    fi
    tried mv -f "$1" "$2" || exit 1
}
# Writes a line to a new file, which takes the place of what is there: a link may be somebody's. LINE FILE
note() {
    draft=$2.$$
    tried rm -f "$draft" && (set -C && printf '%s\n' "$1" >"$draft") && tried rm -f "$2" && tried mv -f "$draft" "$2"
}
# Moves a file or folder to a new folder in older/.
put_aside() {
    aside=$(tried mktemp -d older/XXXXXX) && tried mv -f "$1" "$aside" || exit 1
}
# Leaves in the folder only those results that the plan has: FOLDER NAMES. Others wait in older/ for a plan that has them. What is not named like a
# result, as `$result` says, stays where it is.
only() {
    tried mkdir -p "$1" || exit 1
    for path in "$1"/*; do
        name=${path#"$1"/}
        case $name in
        $result) ;;
        *) continue ;;
        esac
        case " $2 " in
        *" $name "*) ;;
        *) move "$path" "older/$name" ;;
        esac
    done
    for name in $2; do
        [ ! -e "older/$name" ] || move "older/$name" "$1/$name"
    done
}
