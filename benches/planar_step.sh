#!/usr/bin/env bash
# One planar training step, 5 x 4096 points: raygrad against PyTorch and JAX in one run, alternating, on two cores.
#
# usage: benches/planar_step.sh [PEERS] [--rounds N]    PEERS: folder of the peers' scripts, by default benches/peers
# RAYGRAD_PYTHON: a Python with torch, jax and numpy (python3 -m venv V && V/bin/pip install torch jax numpy)
# RAYGRAD_CPUS: the cores to use, by default 0,1
source "$(dirname "$0")/common.sh"
peers=${RAYGRAD_PEERS:-$root/benches/peers}
case ${1:-} in "" | --*) ;; *) peers=$1; shift ;; esac
build --bin raygrad --example planar_step
pin=()
if command -v taskset >/dev/null; then pin=(taskset -c "${RAYGRAD_CPUS:-0,1}"); fi
exec "${pin[@]}" "$built/examples/planar_step" \
    --raygrad "$RAYGRAD" --python "${RAYGRAD_PYTHON:-python3}" --peers "$peers" "$@"
