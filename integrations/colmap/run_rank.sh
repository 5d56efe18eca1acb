# A map of COLMAP is whole when its size is what its head says: WIDTH&HEIGHT&CHANNELS& and as many floats.
whole() {
    [ -f "$1" ] || return 1
    head=$(head -c 40 -- "$1" | LC_ALL=C tr -c '0-9&' ' ' | cut -d '&' -f 1-3)
    width=${head%%&*} rest=${head#*&}
    height=${rest%%&*} channels=${rest#*&}
    case $width$height$channels in '' | *[!0-9]*) return 1 ;; esac
    [ "$(wc -c < "$1")" -eq $((${#head} + 1 + 4 * width * height * channels)) ]
}
# --rank N: the depth map of the N-th key view alone, made anew unless it is whole and of this plan; for queues.
if [ "${1:-}" = --rank ]; then
    KEY=$(sed -n "${2}p" stereo/viewrank/ranks.txt)
    export KEY
    map=$KEY.photometric.bin list=stereo/viewrank/rank-$2.cfg
    # Lines of references and of sources take turns.
    awk '/^#/ { next } ++n % 2 { reference = $0; next } reference == ENVIRON["KEY"] { print reference; print }' \
        stereo/patch-match.cfg > "$list"
    if ! { whole "stereo/depth_maps/$map" && whole "stereo/normal_maps/$map"; } || grep -qxF -- "$map" stereo/viewrank/replace.txt; then
        rm -f -- "stereo/depth_maps/$map" "stereo/normal_maps/$map"
    fi
    @COMMAND@
    rm -f -- "$list"
    if ! { whole "stereo/depth_maps/$map" && whole "stereo/normal_maps/$map"; }; then
        echo "$KEY: COLMAP left no whole depth map" >&2
        exit 1
    fi
    exit 0
fi
