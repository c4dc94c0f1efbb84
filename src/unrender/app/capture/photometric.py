"""Photometric stereo: normals and colours of a surface from photographs of one camera under known lights.

Least squares of Woodham (1980), the start that others are measured against: where a pixel lies in no shadow, a matt surface shows

    I_k = ρ n · l_k,   so that   ρ n = argmin Σ_k (I_k - g · l_k)²,

l_k towards light k, ρ the reflectance times the light's strength, n the normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from unrender.app.capture import pictures
from unrender.app.capture.cameras import Lens
from unrender.app.capture.formats.lights import LitCapture
from unrender.app.capture.undistortion import Resampling, pinhole
from unrender.core.errors import InputError
from unrender.losses.metrics import srgb

__all__ = ["LitViews", "least_squares", "lit", "prepare"]

_SHADOW = 0.1
"""Of the brightest a pixel becomes: what is darker may lie in a shadow."""
_WHITE = 0.97
_CLEARER = 0.9
"""How much smaller the residual of values as stored has to be for them to be taken as linear."""


@dataclass(frozen=True)
class LitViews:
    """Photographs at the chosen resolution.

    Attributes:
        names: of the photographs.
        values: (N, H, W, 3) float32, linear.
        directions: (N, 3) unit, towards the lights.
        mask: (H, W) in [0, 1], the part of a pixel that the object covers.
        held_out: of each, whether it is for judging alone.
        linear: whether the files' values were taken as linear.
    """

    names: tuple[str, ...]
    values: np.ndarray
    directions: np.ndarray
    mask: np.ndarray
    held_out: tuple[bool, ...]
    linear: bool

    @property
    def training(self) -> np.ndarray:
        """Indices of those that are not held out."""
        return np.flatnonzero(~np.array(self.held_out))


def prepare(capture: LitCapture, resolution: int, scale: float | None, hold_out: int | None) -> LitViews:
    """Read all photographs, at most `resolution` pixels along the longer side.

    Files of 8 or 16 bits are taken as sRGB, or as linear where a matt surface explains their values as stored clearly better.

    Args:
        capture: what the folder holds.
        resolution, scale: see `views.prepare`.
        hold_out: every so many lights one is held out, 0 for none; None for 6.

    Raises:
        InputError: a photograph cannot be read, has another size, or the mask is empty.
    """
    every = 6 if hold_out is None else hold_out
    if every == 1 or every < 0:
        raise InputError(f"--hold-out {every}: expected 0 for none, or at least 2")
    width, height, _ = pictures.upright(capture.photographs[0], None)
    lens = Lens(width, height, float(width), float(width), width / 2, height / 2)
    target = pinhole(lens, min(1.0, resolution / max(width, height)) if scale is None else scale)
    resample = Resampling(lens, target)
    found = []
    for path in capture.photographs:
        read = pictures.read(path).values
        if read.shape[:2] != (height, width):
            has = f"{read.shape[1]} x {read.shape[0]} pixels, the first photograph {width} x {height}"
            raise InputError(f"{path}: {has}: one camera that stands still has one size")
        found.append(resample.apply(read)[0])
    mask = np.ones(found[0].shape[:2], np.float32)
    if capture.mask is not None:
        given = pictures.read_mask(capture.mask)
        if given.shape != (height, width):
            raise InputError(f"{capture.mask}: {given.shape[1]} x {given.shape[0]} pixels, expected {width} x {height}")
        mask = np.clip(resample.apply(given[..., None])[0][..., 0], 0, 1)
        if not (mask > 0.999).any():
            raise InputError(f"{capture.mask}: empty (black); expected white on the object")
    count = len(found)
    held_out = tuple(bool(every and index % every == every // 2) for index in range(count))
    if count - sum(held_out) < 4:
        held_out = (False,) * count
    views = LitViews(
        tuple(path.name for path in capture.photographs), np.array(found), capture.directions, mask, held_out, False
    )
    if float(views.values.max()) > 1.001:  # no photograph's of 8 or 16 bits
        return views
    stored = replace(views, values=srgb(views.values).astype(np.float32), linear=True)
    return stored if _residual(stored) < _CLEARER * _residual(views) else views


def _residual(views: LitViews) -> float:
    """Relative root mean square residual of least squares where no shadow falls and nothing is white."""
    chosen = views.training
    values = views.values[chosen][:, views.mask > 0.999].mean(-1)
    clear = lit(values) & (values < _WHITE).all(0)
    if clear.sum() < 16:
        return np.inf
    values = values[:, clear]
    lights = views.directions[chosen]
    left = lights @ np.linalg.lstsq(lights, values, rcond=None)[0] - values
    return float(np.sqrt((left**2).mean() / (values**2).mean()))


def lit(values: np.ndarray) -> np.ndarray:
    """Of brightnesses (N, ...) under N lights: whether none is so dark beside the brightest that a shadow may fall there."""
    return (values > _SHADOW * values.max(0)).all(0) & (values.max(0) > 0)


def least_squares(values: np.ndarray, directions: Sequence[np.ndarray] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (..., 3) of unit length and reflectances (..., 3) per channel, of linear values (N, ..., 3) under N lights.

    Shadows count as if they were dark colours. Normals are of the mean of the channels; where all is black, they face the camera.
    """
    lights = np.asarray(directions, float)
    flat = np.asarray(values, float).reshape(len(lights), -1, 3)
    scaled = np.linalg.lstsq(lights, flat.mean(2), rcond=None)[0].T
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    normal = np.where(length > 0, scaled / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])
    shading = np.maximum(lights @ normal.T, 0)[..., None]
    colour = (flat * shading).sum(0) / np.maximum((shading**2).sum(0), 1e-12)
    return normal.reshape(*values.shape[1:-1], 3), colour.reshape(values.shape[1:])
