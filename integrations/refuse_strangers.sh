# Refuses to start where anything at or below the paths is neither a file nor a folder: the script, or the program that it calls, would follow a link out
# of this folder, and wait for a pipe for ever. LINKS lists the links that viewrank made itself: LINKS PATH...
refuse_strangers() {
    links=$1
    shift
    if [ "$links" != /dev/null ] && { [ -L "$links" ] || [ ! -f "$links" ]; }; then
        refuse "$links"
    fi
    # A folder that cannot be listed may hide links, and a line break in a name would make two entries of one. Names are bytes in any encoding. The word at
    # the end says that all were looked at.
    found=$(LC_ALL=C find "$@" '(' ! -type f ! -type d -o -type d ! -perm -500 -o -name '*
*' ')' | LC_ALL=C awk -v links="$links" '
        BEGIN { while ((getline link < links) > 0) known[link] }
        !($0 in known) && !stranger { stranger = 1; print }
        END { if (!stranger) print "none" }')
    [ "$found" = none ] || refuse "$found"
}
# Ends the script because of a path, which is shown without what a terminal would obey.
refuse() {
    printf 'error: %s: not made by viewrank: move it away, or put the file or folder itself in the place of a link\n' \
        "$(printf %s "$1" | LC_ALL=C tr -c ' -~' '?')" >&2
    exit 1
}
