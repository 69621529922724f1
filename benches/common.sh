# Sourced by the scripts beside it: builds the measurements and sets $raygrad to the command they measure.
# RAYGRAD_QUICK=1 does a minimum of work in the dev profile: it proves that the scripts run and measures nothing.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
profile=release
[ -z "${RAYGRAD_QUICK:-}" ] || profile=debug
built=${CARGO_TARGET_DIR:-$root/target}/$profile

build() {
    local options=(--manifest-path "$root/Cargo.toml" --quiet -p raygrad -p raygrad-benches "$@")
    [ $profile = debug ] || options+=(--release)
    cargo build "${options[@]}"
    export RAYGRAD=${RAYGRAD:-$built/raygrad}
}
