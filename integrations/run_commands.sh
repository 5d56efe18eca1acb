#!/bin/sh
# Runs the commands of viewrank's plan in this folder, each if the one before succeeds.
set -eu
@RESTART@
@REFUSE_STRANGERS@
refuse_strangers . << 'LINKS' || exit 1
@LINKS@
LINKS
own_files .
