if [ "${1:-}" != --fuse ]; then
    # The maps that another run is computing have its notes. What COLMAP itself holds open keeps the lock as long as it computes.
    exec 9< stereo/viewrank
    if command -v flock > /dev/null; then
        status=0
        flock -n 9 || status=$?
        if [ "$status" -eq 1 ]; then
            echo "error: another run.sh computes here" >&2
            exit 1
        fi
    fi
    trap bring_all_back EXIT
    trap 'exit 130' INT
    trap 'exit 143' TERM
    bring_all_back
    [ "${1:-}" != --replace ] || set_aside < "$maps"
