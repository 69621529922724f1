#!/usr/bin/env bash
# From recording to launches: milliseconds of each stage for the planar models, medians of several processes.
#
# usage: benches/compile_time.sh [RUNS]
source "$(dirname "$0")/common.sh"
build --bin raygrad
runs=${1:-9}
[ -z "${RAYGRAD_QUICK:-}" ] || runs=1
for preset in planar-l2g planar-barf; do
    printf '%s, medians of %d runs\n' $preset "$runs"
    for _ in $(seq "$runs"); do "$RAYGRAD" explain $preset --set data.points_per_patch=4096 --timing; done |
        awk '$NF == "ms" {
                 time = $(NF - 1); name = $0; sub(/ +[0-9.]+ ms$/, "", name)
                 if (!(name in count)) order[++names] = name
                 times[name, ++count[name]] = time
             }
             END {
                 for (i = 1; i <= names; i++) {
                     name = order[i]; n = count[name]
                     for (a = 2; a <= n; a++)
                         for (b = a; b > 1 && times[name, b - 1] > times[name, b]; b--) {
                             t = times[name, b]; times[name, b] = times[name, b - 1]; times[name, b - 1] = t
                         }
                     printf "  %-24s %8.2f ms\n", name, times[name, int((n + 1) / 2)]
                 }
             }'
done
