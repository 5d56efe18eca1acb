# Refuses to start where anything at or below the paths is neither a file nor a folder: the script, or the program that it calls, would follow a link out
# of this folder, and wait for a pipe for ever. The input lists the links that viewrank made itself: PATH...
refuse_strangers() {
    # A folder that cannot be listed may hide links, and a line break in a name would make two entries of one. Names are bytes in any encoding.
    command -v find > /dev/null || {
        say "error: no program find on the PATH: it looks for links that are not viewrank's" >&2
        exit 1
    }
    found=$({
        cat
        echo
        LC_ALL=C find "$@" '(' ! -type f ! -type d -o -type d ! -perm -500 -o -name '*
*' ')' -print -o -type d -exec sh -c '
        for folder; do
            [ -r "$folder" ] && [ -x "$folder" ] || printf "%s\n" "$folder"
        done' sh '{}' + 2>/dev/null || :
    } | LC_ALL=C awk '
        $0 == "" && !listed { listed = 1; next }
        !listed { known[$0]; next }
        !($0 in known) && !stranger { stranger = 1; print }
        END { if (listed && !stranger) print "none" }')
    [ "$found" = none ] || refuse "$found"
    refuse_no_files "$@"
}
# Refuses what is in the place of a picture, which may be a link: a pipe, a device, and a link to one or to a folder, of which a program would copy a whole
# file system, or wait for ever. A link that leads nowhere is a picture that is missing, which the program says. PATH...
refuse_no_files() {
    found=$({
        find "$@" ! -type f '(' -type d ! -perm -500 -print -o ! -type d ! -type l -print -o -type l -exec sh -c '
            for link; do
                [ -f "$link" ] || [ ! -e "$link" ] || printf "%s\n" "$link"
            done' sh '{}' + ')' 2>/dev/null || :
        echo none
    } | head -n 1)
    [ "$found" = none ] || refuse "$found"
}
# Gives files that have other names, which may be somebody else's, a file of their own, before a program writes into what is there: PATH... A list of
# lines would make two files of one with a line break in its name, which a script's own folder may have.
own_files() {
    find "$@" -type f -links +1 -exec sh -c '
        for file; do
            own=$(mktemp "${file%/*}/XXXXXX") && cp -p "$file" "$own" && mv -f "$own" "$file" || exit 1
        done' sh '{}' + 2>/dev/null || {
        say "error: failed: copies of the files in $* that have other names, which may be somebody else's" >&2
        exit 1
    }
}
# Records in done/, for scripts and viewrank run, what a depth map is made from: NAME LINE
mark() {
    draft=$(tried mktemp done/XXXXXX) && printf '%s\n' "$2" > "$draft" && tried mv -f "$draft" "done/$1"
}
# Refuses a list of more than 64 MiB, which is more than that of a hundred thousand images, before anything reads it: FILE. The system counts blocks of 512 bytes.
refuse_long() {
    [ -z "$(find "$1" -type f -size +131072 2>/dev/null)" ] || {
        say "error: $1: longer than the 64 MiB that a list of viewrank may have: move it away" >&2
        exit 1
    }
}
# Refuses to start while another script, or viewrank run, works in the folder; what a program holds open keeps the lock as long as that computes: FOLDER
alone() {
    exec 9< "$1"
    status=0
    ! command -v flock > /dev/null || flock -n 9 || status=$?
    if [ "$status" -eq 1 ]; then
        echo "error: another run.sh or viewrank run computes here" >&2
        exit 1
    fi
}
# Calls a tool whose own messages would have names of strangers in them as they are: COMMAND...
tried() {
    "$@" 2>/dev/null || {
        say "error: failed: $*" >&2
        return 1
    }
}
# Ends the script because of a path.
refuse() {
    say "error: $1: not made by viewrank: move it away, or put the file or folder itself in the place of a link" >&2
    exit 1
}
# Prints a line, which may have names of strangers in it, without what a terminal would obey.
say() {
    printf '%s' "$1" | LC_ALL=C tr -c ' -~' '?'
    echo
}
