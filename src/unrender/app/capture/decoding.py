"""Decoding of a photograph's file to linear values by the response curve of `--response`."""

from __future__ import annotations

import math

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.io import images

SRGB, LINEAR, FIT = "srgb", "linear", "fit"
_LEAST, _MOST = 1.0, 4.0
"""Range of exponents. Those of cameras and screens are between 1 and 2.6."""


def check(response: str) -> str:
    """Return the name of a response unchanged. Raise `InputError` if it is invalid."""
    if response not in (SRGB, LINEAR, FIT):
        _exponent(response)
    return response


def linear(levels: np.ndarray, response: str) -> np.ndarray:
    """Decode levels in [0, 1], of any shape, to linear values by a response. The curve is increasing and maps 0 and 1 to themselves.

    "srgb" and "fit" select the sRGB curve, a number γ the power levels ** γ, and "linear" the identity.
    """
    if response in (SRGB, FIT):
        return images.srgb_to_linear(levels)
    return levels if response == LINEAR else levels ** _exponent(response)


def _exponent(text: str) -> float:
    names = f"{SRGB}, {LINEAR}, {FIT} or an exponent from {_LEAST:g} to {_MOST:g}, such as 2.2"
    expected = f"--response {printable(text[:40])}: expected {names}"
    try:
        exponent = float(text)
    except ValueError as error:
        raise InputError(expected) from error
    if not math.isfinite(exponent) or not _LEAST <= exponent <= _MOST:
        raise InputError(expected)
    return exponent
