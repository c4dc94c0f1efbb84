"""The networks of the tasks CNN and CNN5: from an image of a mug to its orientation, or to rotation, position and colour.

The paper gives the sizes alone, 267 745 parameters for one output and 268 773 for five. Their difference is four rows of 257, so the last
layer reads 256 features; three convolutions of 3 × 3 with 16 channels, each halving an image of 64 × 64, and a layer of 256 on what
they leave (16 × 8 × 8) make exactly these numbers.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

torch: Any = importlib.import_module("torch")
nn = torch.nn

RESOLUTION = 64


class PoseNetwork(nn.Module):
    """Images (K, 64, 64, 3), linear, to (K, outputs).

    Halves by stride, which the paper does not say, and by default with a smooth activation, so that its second derivatives are those of
    what it computes; `nn.ReLU` has them piecewise.
    """

    def __init__(self, outputs: int, activation: Callable[[], Any] = nn.SiLU):
        super().__init__()
        layers: list[Any] = []
        for channels in (3, 16, 16):
            layers += [nn.Conv2d(channels, 16, kernel_size=3, stride=2, padding=1), activation()]
        side = RESOLUTION // 8
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(16 * side * side, 256), activation(), nn.Linear(256, outputs)
        )

    def forward(self, images: Any) -> Any:
        return self.layers(images.permute(0, 3, 1, 2))


def parameter_count(network: Any) -> int:
    """How many weights it has."""
    return sum(weight.numel() for weight in network.parameters())
