# Refuses to start where anything at or below the paths is neither a file nor a folder: the script, or the program that it calls, would follow a link out
# of this folder, and wait for a pipe for ever. LINKS lists the links that viewrank made itself: LINKS PATH...
refuse_strangers() {
    links=$1
    shift
    if [ "$links" != /dev/null ] && { [ -L "$links" ] || [ ! -f "$links" ]; }; then
        stranger=$links
    else
        # A line break in a name would make two entries of one.
        stranger=$(find "$@" '(' ! -type f ! -type d -o -name '*
*' ')' 2>/dev/null | grep -vxF -f "$links" | head -n 1)
    fi
    if [ -n "$stranger" ]; then
        echo "error: $stranger: not made by viewrank, and no file or folder that this script may use; move it away" >&2
        exit 1
    fi
}
