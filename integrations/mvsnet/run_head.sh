#!/bin/sh
# Computes the depth maps of viewrank's plan, in rank order, and joins them; a second start computes all of them again. `viewrank run PROJECT` does the
# rest: it computes what is missing, checks each map, and joins those that are finished, of two sizes as well.
# PATCHMATCHNET: the folder of eval.py; CHECKPOINT: the weights, from that folder on; PYTHON: a Python that has PyTorch.
set -eu
@RESTART@
@REFUSE_STRANGERS@
# Leftovers of a killed viewrank run are ignored.
refuse_strangers . -path ./unfinished -prune -o << 'LINKS' || exit 1
@LINKS@
LINKS
alone .
own_files .
PATCHMATCHNET=$(cd "$OLDPWD" && cd "${PATCHMATCHNET:?the folder of its eval.py}" && pwd -P && echo .) && PATCHMATCHNET=${PATCHMATCHNET%??}
(cd "$PATCHMATCHNET" && [ -f eval.py ] && [ -f "${CHECKPOINT:-checkpoints/params_000007.ckpt}" ]) || {
    say "error: $PATCHMATCHNET: no eval.py, or no ${CHECKPOINT:-checkpoints/params_000007.ckpt}" >&2
    exit 1
}
tried mkdir -p done
# Forgets that a depth map is made from something else: NAME LINE
begin() {
    made=$(head -c 16 "done/$1" 2> /dev/null | LC_ALL=C tr -c '0-9a-z' '?') || made=
    [ "$made" = "$2" ] || mark "$1" unfinished
}
