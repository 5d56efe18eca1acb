if [ "${1:-}" = --rank ]; then
    KEY=$(sed -n "${2}p" stereo/viewrank/ranks.txt 2>/dev/null) || KEY=
    if [ -z "$KEY" ]; then
        echo "error: --rank $2: the key views have the ranks 1 to $(wc -l < stereo/viewrank/ranks.txt)" >&2
        exit 2
    fi
    export KEY
    map=$KEY.photometric.bin list=stereo/viewrank/rank-$2.cfg
    trap 'bring_back "$map"' EXIT
    trap 'exit 130' INT
    trap 'exit 143' TERM
    bring_back "$map"
    rm -f -- "$list"
    # Lines of references and of sources take turns.
    awk '/^#/ { next } ++n % 2 { reference = $0; next } reference == ENVIRON["KEY"] { print reference; print }' \
        stereo/patch-match.cfg > "$list"
    lines_of "$list" photometric | set_aside
    @COMMAND@
    rm -f -- "$list"
    if ! there "$map"; then
        say "$KEY: COLMAP left no whole depth map" >&2
        exit 1
    fi
    exit 0
fi
