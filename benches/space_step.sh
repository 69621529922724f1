#!/usr/bin/env bash
# One training step in space, 200 rays x 128 samples at the paper's width: raygrad against PyTorch and JAX, see `against_peers` in common.sh.
#
# usage: benches/space_step.sh [PEERS] [--rounds N] [--mixed]    PEERS: folder of the peers' scripts, by default benches/peers
source "$(dirname "$0")/common.sh"
against_peers space "$@"
