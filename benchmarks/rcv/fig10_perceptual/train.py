"""Weights of VGG-16's first two blocks, trained in a minute on pictures that come with scikit-image.

The task is to tell from which of the pictures a crop is. That is far from ImageNet; it gives what the benchmark needs: features that
answer to edges, colours and textures, of VGG's own shape, from nothing that must be fetched. The picture on the benchmark's wall is not
among them.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

PICTURES = (
    "brick", "camera", "cell", "chelsea", "coffee", "coins", "grass", "gravel", "hubble_deep_field", "immunohistochemistry", "moon",
    "page", "retina", "rocket", "text",
)  # fmt: skip
WIDTHS = (64, 64, 128, 128)
NUMBERS = (0, 2, 5, 7)
"""Of the convolutions among torchvision's features."""
LAYERS = ("relu1_2", "relu2_2")
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def pictures() -> list[np.ndarray]:
    """All, (H, W, 3) in [0, 1], sRGB, at half their size."""
    from skimage import data
    from skimage.color import gray2rgb
    from skimage.util import img_as_float

    found = []
    for name in PICTURES:
        picture = img_as_float(getattr(data, name)())
        picture = gray2rgb(picture) if picture.ndim == 2 else picture[..., :3]
        height, width = (side // 2 * 2 for side in picture.shape[:2])
        halves = picture[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
        found.append(halves.astype(np.float32))
    return found


def crops(given: list[np.ndarray], count: int, side: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3, side, side), normalised as VGG's inputs are, and from which picture each is, (count,)."""
    labels = rng.integers(len(given), size=count)
    found = []
    for label in labels:
        picture = given[label]
        y, x = (rng.integers(size - side + 1) for size in picture.shape[:2])
        crop = picture[y : y + side, x : x + side]
        found.append(crop[:, ::-1] if rng.random() < 0.5 else crop)
    batch = (np.stack(found) - MEAN) / DEVIATION
    return np.ascontiguousarray(np.moveaxis(batch, -1, 1), np.float32), labels


def train(path: Path, steps: int = 1000, batch: int = 16, side: int = 24, seed: int = 0) -> dict[str, Any]:
    """Writes the weights, named as torchvision names VGG-16's; the same at every call on one machine.

    Args:
        path: of the file, .pth.
        side: of the crops, in pixels.

    Returns:
        "accuracy" on 300 crops that it was not trained on, "chance", and the "losses" of the steps.
    """
    torch: Any = importlib.import_module("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        torch.manual_seed(seed)
        rng, given = np.random.default_rng(seed), pictures()
        first, second, third, fourth = (
            torch.nn.Conv2d(inputs, outputs, 3, padding=1)
            for inputs, outputs in zip((3, *WIDTHS), WIDTHS, strict=False)
        )
        convolutions = (first, second, third, fourth)
        for convolution in convolutions:
            torch.nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            torch.nn.init.zeros_(convolution.bias)
        relu, answer = torch.nn.ReLU(), torch.nn.Linear(WIDTHS[-1], len(given))
        body = torch.nn.Sequential(first, relu, second, relu, torch.nn.MaxPool2d(2), third, relu, fourth, relu)
        optimizer = torch.optim.Adam([*body.parameters(), *answer.parameters()], lr=1e-3)
        losses = []
        for _ in range(steps):
            x, labels = (torch.from_numpy(part) for part in crops(given, batch, side, rng))
            loss = torch.nn.functional.cross_entropy(answer(body(x).mean(dim=(2, 3))), labels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            x, labels = crops(given, 300, side, np.random.default_rng(seed + 1))
            found = answer(body(torch.from_numpy(x)).mean(dim=(2, 3))).argmax(dim=1).numpy()
        tensors = {}
        for number, convolution in zip(NUMBERS, convolutions, strict=True):
            tensors[f"features.{number}.weight"] = convolution.weight.detach().clone()
            tensors[f"features.{number}.bias"] = convolution.bias.detach().clone()
        torch.save(tensors, path)
    finally:
        torch.set_num_threads(threads)
    return {"accuracy": float((found == labels).mean()), "chance": 1 / len(given), "losses": losses}
