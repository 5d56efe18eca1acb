#!/bin/sh
# Joins the depth maps of viewrank's plan that are there, unless the same ones were joined before.
@ABSOLUTE_PATH@
# sh names the script in its own messages, and the folders above it may have a stranger's names: it is started again as a name of our own. A copy of a queue's has one.
case $0 in
.//fuse.sh) ;;
*/fuse.sh)
    unset CDPATH
    cd -- "${0%/*}/" && exec sh .//fuse.sh "$@"
    exit 1
    ;;
esac
@HEAD@
set -u
@REFUSE_STRANGERS@
@LIST@
refuse_strangers /dev/null "$folder"
refuse_forged_list
tab=$(printf '\t')
# Of runs that were killed.
for old in "$folder/fused.$(uname -n)".*; do
    kill -0 "${old##*.}" 2>/dev/null || tried rm -f "$old" || exit 1
done
found=$folder/fused.$(uname -n).$$
trap 'rm -f "$found"' EXIT
rm -f "$found"
missing=0
while IFS=$tab read -r rank marker id map key; do
    if [ -s "$map" ] && { [ "$rank" -le "$finished" ] || [ "$(noted "$folder/done/$marker")" = "$id" ]; }; then
        printf '%s\n' "$id"
    else
        missing=$((missing + 1))
    fi
done < "$list" > "$found"
echo "$(wc -l < "$found") depth maps are there, $missing are not"
if [ ! -s "$found" ] || cmp -s "$found" "$folder/fused"; then
    echo 'nothing new to join'
    exit 0
fi
fuse || exit 1
tried mv -f "$found" "$folder/fused"
