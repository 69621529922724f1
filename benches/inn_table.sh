#!/usr/bin/env bash
# The planar table of the invertible warp's supplement (its Table 3) at reduced resolution and width: BARF's distortions of the
# built-in photo, 20 seeds; success rates, corner errors and PSNR of BARF, L2G, one invertible network a patch, and one for all.
#
# usage: benches/inn_table.sh [--seeds FIRST..END] [--presets A,B,...] [--set KEY=VALUE]...
source "$(dirname "$0")/common.sh"
build --example seeds
exec "$built/examples/seeds" --seeds 0..20 \
    --presets planar-barf-small,planar-l2g-small,planar-multi-inn-small,planar-inn-small \
    --set noise.kind=barf --set noise.homography=0.1 --set noise.translation=0.2 \
    --set 'field.layers=[128,128,128,128]' --set 'warp.layers=[128,128,128,128,128,128]' --set optim.steps=1500 "$@"
