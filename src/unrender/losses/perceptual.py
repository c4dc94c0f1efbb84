"""Perceptual loss between features of a network, which is tolerant to the exact position of details.

The network is VGG-16 (Simonyan and Zisserman 2015) with thirteen convolutions. The loss is the mean squared difference of the features of
some layers (Johnson, Alahi and Fei-Fei 2016, Eq. 2). It needs PyTorch and the network's weights.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import Positive
from unrender.core.errors import InputError, prefixed
from unrender.core.registry import register
from unrender.core.text import did_you_mean, in_words, reason_of
from unrender.io import bounded_files

_SAFE_UNPICKLER = (2, 6)
"""Oldest version of PyTorch with a safe `weights_only`: earlier ones may execute code from the file (CVE-2025-32434)."""
_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of the convolutions by block; the resolution is halved between blocks."""

LAYERS = {
    f"relu{block}_{place}": block for block, widths in enumerate(_BLOCKS, 1) for place in range(1, len(widths) + 1)
}
"""Layers whose features can be compared, each after its ReLU, with the index of its block."""

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of the network's training images, in sRGB."""


@register(position=5)
@dataclass(frozen=True)
class Perceptual:
    """strength · mean over `layers` of mean (φₗ(I) − φₗ(R))², for VGG-16's features φₗ of images in sRGB.

    The loss is of a full image: `value` returns it in each element of the image, so that their mean is the loss, and `derivative` is
    scaled accordingly. Pixel mini-batches do not support it (`pixelwise`). Radiance is converted by the sRGB curve, which continues above
    1. Negative radiance counts as 0, with zero derivative. The derivative is not linear in the image, so noise biases the gradient: the
    network sees noise as texture. Use an image estimator with little noise (`images.RecursiveControlVariate`, `images.Denoised`).

    Args:
        weights: file of the network's weights: a .safetensors file, or a .pth file with tensors only, with torchvision's names
            (features.0.weight, ...; others are ignored). None takes torchvision's, which it downloads at first use.
        layers: features to compare, from `perceptual.LAYERS`. relu3_3 needs images of at least 4 x 4, relu5_3 of 16 x 16.
        strength: factor of the loss, > 0.

    Raises:
        InputError: PyTorch is missing; weights are missing, damaged or of another network; a layer does not exist; `value` gets an image
            that is too small for a layer.
    """

    weights: str | Path | None = None
    layers: tuple[str, ...] = ("relu1_2", "relu2_2", "relu3_3")
    strength: Positive = 1.0
    linear, pixelwise = False, False

    def __post_init__(self):
        checks.fields(self)
        if isinstance(self.layers, str) or not isinstance(self.layers, (list, tuple)) or not self.layers:
            raise InputError(f"Perceptual: layers must be a list of names such as relu3_3, got {in_words(self.layers)}")
        for name in self.layers:
            if not isinstance(name, str) or name not in LAYERS:
                hint = did_you_mean(name, LAYERS) or f"; there are {', '.join(LAYERS)}"
                raise InputError(f"Perceptual: layers: there is no {in_words(name)}{hint}")
        object.__setattr__(self, "layers", tuple(self.layers))
        if self.weights is not None and not isinstance(self.weights, (str, Path)):
            raise InputError(f"Perceptual: weights must be a file, got {in_words(self.weights)}")
        self._network(np.dtype(np.float32))  # reports an invalid file at construction

    def value(self, image: Array, reference: Array) -> Array:
        """Return the loss of each image (..., H, W, 3), repeated in all its elements."""
        values = arrays.numpy(image)
        losses, _ = self._compare(values, arrays.numpy(reference), derivative=False)
        return arrays.like(np.broadcast_to(losses[..., None, None, None], values.shape), image)

    def derivative(self, image: Array, reference: Array) -> Array:
        """Return H · W · 3 times the derivative of each image's loss, (..., H, W, 3)."""
        values = arrays.numpy(image)
        _, slope = self._compare(values, arrays.numpy(reference), derivative=True)
        return arrays.like(slope * float(np.prod(values.shape[-3:])), image)

    def _compare(self, image: np.ndarray, reference: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the loss of each image, (...), and its derivative, (..., H, W, 3); zeros if it is not requested."""
        torch = _torch()
        height, width = image.shape[-3:-1]
        for name in self.layers:
            if min(height, width) < 2 ** (LAYERS[name] - 1):
                raise InputError(f"Perceptual: an image of {width}x{height} is too small for the layer {name}")
        network = self._network(np.dtype(np.float64 if image.dtype == np.float64 else np.float32))
        batch = torch.from_numpy(np.array(image.reshape(-1, height, width, 3), network.dtype)).requires_grad_(
            derivative
        )
        target = torch.from_numpy(np.array(reference.reshape(-1, height, width, 3), network.dtype))
        with torch.no_grad():
            target_features = network.features(target)
        with torch.set_grad_enabled(derivative):
            losses: Any = sum(
                ((a - b) ** 2).mean(dim=(1, 2, 3))
                for a, b in zip(network.features(batch), target_features, strict=True)
            )
            losses = losses * (self.strength / len(self.layers))
            slope = torch.autograd.grad(losses.sum(), batch)[0] if derivative else torch.zeros_like(batch)
        return losses.detach().numpy().reshape(image.shape[:-3]), slope.numpy().reshape(image.shape)

    def _network(self, dtype: np.dtype) -> _Network:
        path = None if self.weights is None else Path(self.weights)
        return _load(path, _age(path), self.layers, dtype.name)


class _Network:
    """The layers of VGG-16 up to the last one that is compared, from tensors {"features.0.weight": ...} of "float32" or "float64"."""

    def __init__(self, tensors: Mapping[str, Any], layers: tuple[str, ...], dtype: str):
        torch = _torch()
        self.dtype, kind = np.dtype(dtype), getattr(torch, dtype)
        self._layers = layers
        self._stages: list[tuple[str, Any]] = []
        inputs, number = 3, 0
        for block, widths in enumerate(_BLOCKS, 1):
            for place, outputs in enumerate(widths, 1):
                weight = _tensor(tensors, f"features.{number}.weight", (outputs, inputs, 3, 3))
                bias = _tensor(tensors, f"features.{number}.bias", (outputs,))
                convolution = torch.nn.Conv2d(inputs, outputs, 3, padding=1, dtype=kind)
                convolution.load_state_dict({"weight": weight, "bias": bias})
                name = f"relu{block}_{place}"
                self._stages.append((name, torch.nn.Sequential(convolution, torch.nn.ReLU()).requires_grad_(False)))
                inputs, number = outputs, number + 2
                if {name for name, _ in self._stages} >= set(layers):
                    return
            self._stages.append(("", torch.nn.MaxPool2d(2)))
            number += 1

    def features(self, images: Any) -> list[Any]:
        """Return the features of images (B, H, W, 3), linear: one tensor (B, C, H', W') per layer."""
        torch = _torch()
        x = torch.clamp(images, min=0)
        x = torch.where(x <= 0.0031308, 12.92 * x, 1.055 * torch.clamp(x, min=0.0031308) ** (1 / 2.4) - 0.055)
        x = ((x - x.new_tensor(_MEAN)) / x.new_tensor(_DEVIATION)).movedim(-1, 1)
        features = {}
        for name, stage in self._stages:
            x = features[name] = stage(x)
        return [features[name] for name in self._layers]


def _torch() -> Any:
    try:
        import torch  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError("Perceptual needs PyTorch: pip install 'unrender[torch]'") from error
    return torch


def _age(path: Path | None) -> int:
    """Return the modification time of a file, which invalidates the cache when it changes."""
    try:
        return 0 if path is None else path.stat().st_mtime_ns
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InputError(f"Perceptual: weights {path}: {getattr(error, 'strerror', None) or error}") from error


@functools.lru_cache(maxsize=4)
def _load(path: Path | None, age: int, layers: tuple[str, ...], dtype: str) -> _Network:
    _torch()
    source = "of torchvision" if path is None else str(path)
    with prefixed(f"Perceptual: weights {source}"):
        return _Network(_from_torchvision() if path is None else _read(path), layers, dtype)


def _read(path: Path) -> Mapping[str, Any]:
    torch = _torch()
    if bounded_files.kind(path) != "file":
        raise InputError("not a file")
    version = tuple(int(part) for part in re.findall(r"\d+", torch.__version__)[:2])
    if path.suffix.lower() != ".safetensors" and version < _SAFE_UNPICKLER:
        raise InputError(f"expected a .safetensors file: PyTorch {torch.__version__} may execute code from other files")
    try:
        if path.suffix.lower() == ".safetensors":
            from safetensors.torch import load_file  # pyright: ignore[reportMissingImports]

            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # PyTorch's unpickler and zip reader may raise anything
        raise InputError(f"cannot be read: {reason_of(error, 200)}") from error
    if not isinstance(tensors, Mapping):
        raise InputError(f"expected named tensors, found a {type(tensors).__name__}")
    return tensors


def _from_torchvision() -> Mapping[str, Any]:
    try:
        from torchvision.models import VGG16_Weights  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError("torchvision is not installed; give a file of weights, or pip install torchvision") from error
    try:
        return VGG16_Weights.IMAGENET1K_V1.get_state_dict(progress=False)
    except Exception as error:  # network or disk errors
        raise InputError(f"cannot be fetched: {' '.join(str(error).split())[:200]}") from error


def _tensor(tensors: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Any:
    if name not in tensors:
        raise InputError(f"has no {name}; expected those of VGG-16, as torchvision names them")
    tensor = tensors[name]
    if tuple(np.shape(tensor)) != shape:
        raise InputError(f"{name} must be of shape {shape}, got {tuple(np.shape(tensor))}")
    if not bool(_torch().isfinite(tensor).all()):
        raise InputError(f"{name} has values that are not finite")
    return tensor
