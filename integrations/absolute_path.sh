# Programs are looked for in absolute folders alone: other entries of the PATH mean the folder of the script, which may be a stranger's.
absolute=
set -f
IFS=:
for entry in ${PATH:-}; do
    case $entry in /*) absolute=$absolute:$entry ;; esac
done
unset IFS
set +f
PATH=${absolute#:}
export PATH
