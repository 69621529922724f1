#!/usr/bin/env bash
# This machine's GPU: first every form of kernel against the f64 reference, then training steps at the papers' sizes, f32,
# through wgpu and Vulkan, against PyTorch on the same GPU (where RAYGRAD_PYTHON has one with CUDA) and against what the device
# does at best; then narrow networks layer by layer against in workgroups. Writes benches/results/<device>.md.
#
# usage: benches/gpu.sh [PEERS] [--rounds N] [--steps N] [--scale S] [--devices wgpu,vulkan]
#        PEERS: folder of the peers' scripts, by default benches/peers; S: a share of the papers' sizes, for slow devices
source "$(dirname "$0")/common.sh"
peers=${RAYGRAD_PEERS:-$root/benches/peers} out=$root/benches/results
case ${1:-} in "" | --*) ;; *) peers=$1; shift ;; esac
build --bin raygrad --example gpu_step
if [ -n "${RAYGRAD_QUICK:-}" ]; then
    out=$(mktemp -d)
else
    cargo test --manifest-path "$root/Cargo.toml" --quiet --release -p raygrad-runtime --test gpu --test gpu_sizes
fi
exec "$built/examples/gpu_step" --raygrad "$RAYGRAD" --python "${RAYGRAD_PYTHON:-python3}" --peers "$peers" --out "$out" "$@"
