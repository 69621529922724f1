# Sourced by the scripts beside it: builds the measurements and sets $raygrad to the command they measure.
# RAYGRAD_QUICK=1 does a minimum of work in the dev profile: it proves that the scripts run and measures nothing.
set -euo pipefail
root=$(cd -P "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
profile=release
[ -z "${RAYGRAD_QUICK:-}" ] || profile=debug
built=${CARGO_TARGET_DIR:-$root/target}/$profile

build() {
    local options=(--manifest-path "$root/Cargo.toml" --quiet -p raygrad -p raygrad-benches "$@")
    [ $profile = debug ] || options+=(--release)
    cargo build "${options[@]}"
    export RAYGRAD=${RAYGRAD:-$built/raygrad}
}

# One training step, planar or in space, against PyTorch and JAX in one run, alternating, on two cores.
# RAYGRAD_PYTHON: a Python with torch, jax and numpy (python3 -m venv V && V/bin/pip install torch jax numpy)
# RAYGRAD_CPUS: the cores to use, by default 0,1
against_peers() {
    local work=$1 peers=${RAYGRAD_PEERS:-$root/benches/peers} pin=()
    shift
    case ${1:-} in "" | --*) ;; *) peers=$1; shift ;; esac
    build --bin raygrad --example peer_step
    if command -v taskset >/dev/null; then pin=(taskset -c "${RAYGRAD_CPUS:-0,1}"); fi
    exec "${pin[@]}" "$built/examples/peer_step" "$work" \
        --raygrad "$RAYGRAD" --python "${RAYGRAD_PYTHON:-python3}" --peers "$peers" "$@"
}
