#!/usr/bin/env bash
# Runs the commands that the documentation shows, each for a few steps, and fails where one fails.
# Every line of every ```sh block counts; blocks marked ```sh no-run are for people only.
#
# usage: scripts/documented.sh RAYGRAD [FILE...]    RAYGRAD: the built command; FILEs: README.md and docs/*.md by default
set -uo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
binary=$(realpath "${1:?usage: scripts/documented.sh RAYGRAD [FILE...]}")
shift
files=("$@")
[ ${#files[@]} -gt 0 ] || files=("$root"/README.md "$root"/docs/*.md)

# Commands run in a folder of their own that looks like the repository and is thrown away.
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for name in assets benches presets scripts; do ln -s "$root/$name" "$work/$name"; done
cd "$work"
cp "$root/assets/chelsea.png" photo.png

export RAYGRAD=$binary
# Scripts of benches/ then do a minimum of work, with this binary.
export RAYGRAD_QUICK=1

# The documented command, cut short.
raygrad() {
    local args=() short=() runs=no
    case ${1:-} in
    train) short=(--steps 3) runs=yes ;;
    bench) short=(--steps 2) runs=yes ;;
    esac
    while [ $# -gt 0 ]; do
        if [ "$1" = --steps ]; then shift 2; else args+=("$1"); shift; fi
    done
    # Settings given last win over those of the preset, not over those of the documented command.
    case "${args[*]}" in *points_per_patch* | *scene.*) ;; *) [ $runs = no ] || short+=(--set data.points_per_patch=64) ;; esac
    "$binary" "${args[@]}" "${short[@]}"
}

count=0 failed=0
run() {
    local line=$1
    case $line in
    scripts/test.sh* | "cargo install"*) return ;;
    "cargo run --release -- "*) line="raygrad ${line#cargo run --release -- }" ;;
    esac
    count=$((count + 1))
    if ! (set -e; eval "$line") >"$work/.out" 2>&1 </dev/null; then
        failed=$((failed + 1))
        printf 'FAILED: %s\n' "$2"
        sed 's/^/    /' "$work/.out"
    fi
}

# Prints "FILE<tab>COMMAND" for every command, continued lines joined, comments and `$ ` prompts dropped.
commands() {
    awk '
        /^```sh[ \t]*$/ { on = 1; next }
        /^```/ { on = 0; next }
        !on { next }
        { sub(/^\$ /, ""); sub(/[ \t]+#.*$/, "") }
        /^[ \t]*(#|$)/ { next }
        { line = line $0 }
        /\\$/ { sub(/\\$/, "", line); next }
        { print FILENAME "\t" line; line = "" }
    ' "$@"
}

while IFS=$'\t' read -r file line; do run "$line" "${file#"$root"/}: $line"; done < <(commands "${files[@]}")
echo "$count documented commands run, $failed failed"
[ "$count" -gt 0 ] && [ "$failed" = 0 ]
