#!/bin/sh
# Computes viewrank's plan cluster by cluster in rank order, and joins the results. The run goes on after a failed cluster and skips finished ones. Results
# carry a hash of their inputs, so those of another plan are not mistaken for these. Exit code 1: something failed.
set -u
cd "$(dirname "$0")" || exit 1
@REFUSE_STRANGERS@
refuse_strangers links.txt .
failed=0
fail() {
    echo "error: $1 failed" >&2
    failed=1
}
# Gives a result its name: FROM TO. Where that is taken, somebody has changed this folder.
move() {
    if [ -e "$2" ]; then
        echo "error: $2 is there already; move it away" >&2
        exit 1
    fi
    mv "$1" "$2" || exit 1
}
# Leaves in the folder only those results that the plan has: FOLDER NAME... Others wait in older/ for a plan that has them. What is not named like a
# result (with a hash of 16 digits, which `$result` matches) stays where it is.
only() {
    folder=$1 names=" $2 "
    mkdir -p "$folder" older || exit 1
    for path in "$folder"/*; do
        name=${path#"$folder"/}
        case $name in
        $result) ;;
        *) continue ;;
        esac
        case $names in
        *" $name "*) ;;
        *) move "$path" "older/$name" ;;
        esac
    done
    for name in $2; do
        [ ! -e "older/$name" ] || move "older/$name" "$folder/$name"
    done
}
