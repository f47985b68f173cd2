#!/bin/sh
# Stands for coflash in the tests of `hil`: answers with a file, named as the command, from the folder that --bus names.
command=$1
while [ $# -gt 1 ]; do
    case $1 in
        --bus) folder=$2 ;;
        --trace) trace=$2 ;;
    esac
    shift
done
[ -z "$trace" ] || cp "$folder/trace" "$trace"
cat "$folder/$command"
