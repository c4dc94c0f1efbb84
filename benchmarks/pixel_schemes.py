"""The pixel samplers that are compared: uniform, in proportion to the loss derivative, adaptive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import unrender as ur
from benchmarks.internals import PixelSampler

SCHEMES: dict[str, Callable[..., PixelSampler]] = {
    "uniform": ur.pixels.Uniform,
    "loss": ur.pixels.LossProportional,
    "adaptive": ur.pixels.Adaptive,
}
COLOURS = {
    "all": "#999999",
    "uniform": "#555555",
    "loss": "#c8781e",
    "adaptive": "#1f6fb4",
    "adaptive, five levels": "#7fb2dd",
    "adaptive, as the paper": "#1fa6b4",
    "adaptive, rcv": "#8a3fa8",
    "all, rcv": "#cf9fe0",
    "adaptive, coupled": "#1a8f4c",
    "all, coupled": "#8fd3aa",
}


def pixels(scheme: str, count: int, **options: Any) -> PixelSampler:
    """The sampler of that name; options that a scheme does not have are left out."""
    known = {"uniform": {"stratified"}, "loss": {"stratified", "samples", "refresh", "uniform"}}.get(scheme)
    return SCHEMES[scheme](count, **{k: v for k, v in options.items() if known is None or k in known})
