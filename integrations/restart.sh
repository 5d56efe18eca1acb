@ABSOLUTE_PATH@
# sh names the script in its own messages, and the folders above it may have a stranger's names: it is started again as a name of our own.
case $0 in
.//run.sh) ;;
*)
    unset CDPATH
    case $0 in */*) here=${0%/*}/ ;; *) here=./ ;; esac
    cd -- "$here" && export OLDPWD && exec sh .//run.sh "$@"
    exit 1
    ;;
esac
