# usage: run.sh PATH/TO/Ori-NAME
# mm3d ($MM3D) is called. A copy of the orientations, Ori-viewrank, takes the ImSec files: the folder that is named stays as it is.
usage="usage: run.sh PATH/TO/Ori-NAME"
ori=$(cd "$OLDPWD" && [ $# -eq 1 ] && cd "$1" 2>/dev/null && pwd -P && echo .) && ori=${ori%??} || {
    say "error: no folder ${1:-} of orientations; $usage" >&2
    exit 2
}
copy=$(pwd -P && echo .) && copy=${copy%??}/Ori-viewrank
case "$copy/" in
"${ori%/}"/*)
    say "error: $ori is the copy that this script makes, or holds it; $usage, of the MicMac project that the model comes from" >&2
    exit 1
    ;;
esac
case "$ori" in
"$copy"/*)
    say "error: $ori is in the copy that this script makes; $usage, of the MicMac project that the model comes from" >&2
    exit 1
    ;;
esac
if [ -e Ori-viewrank ] && [ ! -e Ori-viewrank/made-by-viewrank ]; then
    say "error: $copy is there and not made by this script; move it away" >&2
    exit 1
fi
refuse_strangers "$ori" < /dev/null
# MicMac obeys the rules in this file, which may hold commands, wherever it is called.
rules=MicMac-LocalChantierDescripteur.xml
[ ! -e "$rules" ] || refuse "$rules"
own_files .
tried rm -rf Ori-viewrank
mkdir Ori-viewrank && : >Ori-viewrank/made-by-viewrank && tried cp -R "$ori"/. Ori-viewrank/ || exit 1
# With other orientations all is to be computed anew.
orientations=$(cat Ori-viewrank/*.xml | cksum | tr ' ' -)
tried cp ImSec/*.xml Ori-viewrank/ || exit 1
