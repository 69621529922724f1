#!/usr/bin/env bash
# The planar table of the invertible warp's supplement (its Table 3) at reduced resolution and width: BARF's distortions, 20
# seeds; success rates, corner errors and PSNR of BARF, L2G, one invertible network a patch, and one for all. The picture is the
# paper's where RAYGRAD_DATA has it, else the built-in photo.
#
# usage: benches/inn_table.sh [--seeds FIRST..END] [--presets A,B,...] [--set KEY=VALUE]...
source "$(dirname "$0")/common.sh"
build --example seeds
picture=()
cat=${RAYGRAD_DATA:-}/planar/cat.jpg
if [ -e "$cat" ]; then picture=(--set "data.image=$cat" --set 'data.image_size=[120,160]'); fi
exec "$built/examples/seeds" --seeds 0..20 \
    --presets planar-barf-small,planar-l2g-small,planar-multi-inn-small,planar-inn-small "${picture[@]}" \
    --set noise.kind=barf --set noise.homography=0.1 --set noise.translation=0.2 \
    --set 'field.layers=[128,128,128,128]' --set 'warp.layers=[128,128,128,128,128,128]' \
    --set 'warp.output_scale=[0.25,0.25]' --set optim.steps=2500 --set optim.warmup_pose=200 "$@"
