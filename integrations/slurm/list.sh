# Refuses a list that viewrank has not written. The scripts remove and write what a marker names, and take a map for finished.
refuse_forged_list() {
    if [ ! -r "$list" ]; then
        say "$list is gone: the plan has changed, dispatch it again" >&2
        exit 1
    fi
    refuse_long "$list"
    forged=$(project=$project workplace=$workplace LC_ALL=C awk -F '\t' '
        # Windows has both separators.
        function leaves(path, folder) {
            inner = substr(path, length(folder) + 1)
            return index(path, folder) != 1 || inner !~ /^[\/\\]/ || inner ~ /[\/\\]\.\.([\/\\]|$)/
        }
        BEGIN { hash = "[0-9a-f]"; hash = hash hash hash hash; hash = "^" hash hash hash hash "$" }
        $1 !~ /^[1-9][0-9]*$/ || length($1) > 9 || $2 !~ hash || $3 !~ hash || NF != 5 || leaves($4, ENVIRON["project"]) && leaves($4, ENVIRON["workplace"]) {
            exit
        }
        { whole = NR }
        END { if (whole == NR) print "none" }' "$list")
    [ "$forged" = none ] || refuse "$list"
}
# Prints the id in a marker, of which no more is read.
noted() {
    head -c 17 "$1" 2>/dev/null | LC_ALL=C tr -c '0-9a-f\n' '?'
}
