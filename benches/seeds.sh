#!/usr/bin/env bash
# L2G, BARF and naive registration of the built-in photo over seeds 0..9, on the same perturbations: success rates, errors.
#
# usage: benches/seeds.sh [--seeds FIRST..END] [--presets A,B,...] [--set KEY=VALUE]...
source "$(dirname "$0")/common.sh"
build --example seeds
exec "$built/examples/seeds" "$@"
