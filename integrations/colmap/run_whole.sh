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
    [ "${1:-}" != --replace ] || discard < "$maps"
