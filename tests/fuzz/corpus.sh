#!/usr/bin/env bash
# Converts a corpus between corpus/TARGET.txt, which is in the repository, and the directory corpus/TARGET, which
# `cargo fuzz` reads and extends. A line of the text file is one input in hex, followed by a space and a name if it has one.
#
#   corpus.sh unpack TARGET    writes each input to a file of the directory
#   corpus.sh pack TARGET      writes the text file from the directory, named inputs first, each content once
set -euo pipefail
cd "$(dirname "$0")"
usage="corpus.sh: unpack TARGET or pack TARGET; targets: $(cd corpus && echo *.txt | sed 's/\.txt//g')"
[ $# -eq 2 ] || { echo "$usage" >&2; exit 2; }
text=corpus/$2.txt
directory=corpus/$2

case $1 in
    unpack)
        [ -f "$text" ] || { echo "$usage" >&2; exit 2; }
        mkdir -p "$directory"
        while read -r hex name; do
            # Use the name that the fuzzer itself would choose for this content.
            [ -n "$name" ] || name=$(printf %b "$(sed 's/../\\x&/g' <<< "$hex")" | sha1sum | cut -d ' ' -f 1)
            printf %b "$(sed 's/../\\x&/g' <<< "$hex")" > "$directory/$name"
        done < "$text"
        ;;
    pack)
        [ -d "$directory" ] || { echo "corpus.sh: $directory does not exist; unpack the corpus first" >&2; exit 1; }
        for file in "$directory"/*; do
            name=$(basename "$file")
            [[ $name =~ ^[0-9a-f]{40}$ ]] && name=
            # Sort named inputs before the others, and short inputs before long ones.
            printf '%s %08d %s %s\n' "${name:-~}" "$(stat -c %s "$file")" "$(od -An -v -tx1 "$file" | tr -d ' \n')" "$name"
        done | LC_ALL=C sort | awk '!seen[$3]++ { print $3 ($4 == "" ? "" : " " $4) }' > "$text.new"
        mv "$text.new" "$text"
        ;;
    *)
        echo "$usage" >&2
        exit 2
        ;;
esac
