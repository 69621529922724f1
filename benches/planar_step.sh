#!/usr/bin/env bash
# One planar training step, 5 x 4096 points: raygrad against PyTorch and JAX, see `against_peers` in common.sh.
#
# usage: benches/planar_step.sh [PEERS] [--rounds N] [--mixed]    PEERS: folder of the peers' scripts, by default benches/peers
source "$(dirname "$0")/common.sh"
against_peers planar "$@"
