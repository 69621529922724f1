#!/usr/bin/env bash
# raygrad on the perturbations that the published L2G-NeRF code drew, beside the curve that it reached with them.
#
# usage: RAYGRAD_DATA=DIR benches/parity.sh    DIR holds parity/*.json and the photos they name
source "$(dirname "$0")/common.sh"
build --example parity
exec "$built/examples/parity"
