#!/usr/bin/env python3
"""Makes the weights file of raygrad's LPIPS from the two files that hold them.

usage: convert_lpips.py TRUNK.pth LPIPS.pth OUT.safetensors

TRUNK.pth  torchvision's AlexNet, as its model zoo ships it (alexnet-owt-7be5be79.pth):
           features.N.weight, features.N.bias
LPIPS.pth  the linear layers of LPIPS 0.1 on AlexNet, in the package lpips: lpips/weights/v0.1/alex.pth
           (linN.model.1.weight)

Needs Python with torch; writes safetensors without further packages. Run by hand, once; no test needs it. The licences
of the two files are those of their authors.
"""

import json
import struct
import sys

import torch

# Where torchvision keeps the five convolutions, and their shapes.
CONVOLUTIONS = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


def take(state, source, shape, path):
    if source not in state:
        sys.exit(f"{path} has no tensor {source}; it has: {', '.join(sorted(state))}")
    tensor = state[source].detach().to(torch.float32).contiguous()
    if tuple(tensor.shape) != shape:
        sys.exit(f"{path}: {source} has shape {tuple(tensor.shape)}, not {shape}")
    return tensor


def write(path, tensors):
    """A length, a JSON header with type, shape and place of each tensor, then their bytes."""
    header, data = {}, b""
    for name, tensor in tensors.items():
        raw = tensor.numpy().astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as out:
        out.write(struct.pack("<Q", len(text)) + text + data)


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    trunk_path, linear_path, out = sys.argv[1:]
    trunk = torch.load(trunk_path, map_location="cpu", weights_only=True)
    linear = torch.load(linear_path, map_location="cpu", weights_only=True)
    tensors = {}
    for i, (layer, shape) in enumerate(CONVOLUTIONS.items()):
        tensors[f"conv{i + 1}.weight"] = take(trunk, f"features.{layer}.weight", shape, trunk_path)
        tensors[f"conv{i + 1}.bias"] = take(trunk, f"features.{layer}.bias", shape[:1], trunk_path)
        tensors[f"lin{i}.weight"] = take(linear, f"lin{i}.model.1.weight", (1, shape[0], 1, 1), linear_path)
    write(out, tensors)
    print(f"{out}: {len(tensors)} tensors")


if __name__ == "__main__":
    main()
