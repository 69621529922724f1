#!/usr/bin/env bash
# Runs every check of the repository: format, lints, tests on all backends, doc tests, documented commands.
# Where no Vulkan driver is found it installs a software one (lavapipe) through apt, and so the validation layer.
#
# usage: scripts/test.sh [--nightly]    --nightly adds the tests that take minutes each
#
# RAYGRAD_DATA=DIR adds the test vectors of the reference implementations in DIR.
set -uo pipefail
cd "$(dirname "$0")/.."

nightly=no
for arg in "$@"; do
    case $arg in
    --nightly) nightly=yes; export RAYGRAD_NIGHTLY=1 ;;
    *) echo "usage: scripts/test.sh [--nightly]" >&2; exit 2 ;;
    esac
done

names=() results=() times=()
failed=0

# Runs a named check, prints its outcome and keeps it for the summary.
check() {
    local name=$1 begun=$SECONDS
    shift
    printf '\n== %s: %s\n' "$name" "$*"
    local result=ok
    "$@" </dev/null || { result=FAILED; failed=1; }
    names+=("$name") results+=("$result") times+=($((SECONDS - begun)))
}

skip() {
    printf '\n== %s: skipped, %s\n' "$1" "$2"
    names+=("$1") results+=("skipped: $2") times+=(0)
}

has() { "$@" >/dev/null 2>&1; }

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo "$@"; fi; }

install_driver() {
    has apt-get --version || { echo "no Vulkan driver and no apt-get to install one" >&2; return 1; }
    as_root apt-get update -q &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends \
            libvulkan1 mesa-vulkan-drivers
}

install_validation() {
    has apt-get --version || { echo "no apt-get to install the Vulkan validation layer" >&2; return 1; }
    as_root apt-get update -q &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends vulkan-validationlayers
}

target=${CARGO_TARGET_DIR:-target}
raygrad=$target/debug/raygrad
# Each test is a process with a device of its own: more than two threads a device only get in each other's way.
export LP_NUM_THREADS=${LP_NUM_THREADS:-2}

if has cargo fmt --version; then check format cargo fmt --all --check; else skip format "rustfmt is not installed"; fi
if has cargo clippy --version; then
    check lints cargo clippy --workspace --all-targets --quiet -- -D warnings
    check "lints, CPU only" cargo clippy -p raygrad --no-default-features --quiet -- -D warnings
else
    skip lints "clippy is not installed"
fi
if has cargo deny --version; then check dependencies cargo deny --offline check bans licenses sources; fi

check build cargo test --workspace --no-run --quiet
if ! "$raygrad" devices 2>/dev/null | grep -q '^wgpu'; then check "software Vulkan driver" install_driver; fi
# What the validation layer says about the Vulkan backend is an error. Without the layer there are no Vulkan adapters.
export RAYGRAD_VULKAN_VALIDATION=1
validates() { "$raygrad" devices 2>/dev/null | grep -q '^vulkan'; }
if ! validates && ! { install_validation && validates; }; then
    export RAYGRAD_VULKAN_VALIDATION=0
    skip "Vulkan validation" "VK_LAYER_KHRONOS_validation is not installed and cannot be"
fi

if has cargo nextest --version; then
    run=(cargo nextest run --workspace --no-fail-fast --cargo-quiet --status-level fail --final-status-level slow)
    [ $nightly = no ] || run+=(--run-ignored all)
    check tests "${run[@]}"
else
    run=(cargo test --workspace --no-fail-fast --quiet --lib --bins --tests)
    [ $nightly = no ] || run+=(-- --include-ignored)
    check tests "${run[@]}"
fi
check "doc tests" cargo test --workspace --doc --quiet
check "documented commands" scripts/documented.sh "$raygrad"

printf '\n== summary\n'
for i in "${!names[@]}"; do printf '%-24s %5d s  %s\n' "${names[$i]}" "${times[$i]}" "${results[$i]}"; done
[ -n "${RAYGRAD_DATA:-}" ] || echo "RAYGRAD_DATA is not set: tests against the reference implementations' numbers were left out"
if [ $failed = 0 ]; then echo "all passed"; else echo "FAILED"; fi
exit $failed
