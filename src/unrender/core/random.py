"""The only source of seeds: a run is a function of (problem, method, seed)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

from unrender.core.errors import InputError
from unrender.core.text import in_words

_MASK = 0xFFFFFFFFFFFFFFFF


def _mix(x: int) -> int:
    """Apply the SplitMix64 finaliser (Steele, Lea and Flood 2014), a bijection of 64-bit integers."""
    x = (x + 0x9E3779B97F4A7C15) & _MASK
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & _MASK
    return x ^ (x >> 31)


LEAST_SEED, LARGEST_SEED = -(1 << 63), (1 << 63) - 1
"""Range of a run's seed, which every file format can store."""


def check_seed(owner: str, seed: Any, runs: int = 1) -> int:
    """Return `seed` as an integer, after checking that the `runs` consecutive seeds from it are in range. Raises `InputError`."""
    is_integer = isinstance(seed, Integral) and not isinstance(seed, bool)
    if is_integer and LEAST_SEED <= (value := int(seed)) <= LARGEST_SEED - (runs - 1):
        return value
    raise InputError(f"{owner}: expected a whole number from -2**63 to 2**63 - {max(runs, 1)}, got {in_words(seed)}")


WARM_UP = 1
"""Stream of the keys of steps whose results are discarded, because they only compile kernels."""


@dataclass(frozen=True)
class Key:
    """Identifier of one random draw of a run.

    Args:
        seed: the run's seed, any integer; `check_seed` gives the range for runs.
        step: the step of the run, from 0.
        stream: the independent stream within the step; `fold` derives further ones.
    """

    seed: int = 0
    step: int = 0
    stream: int = 0

    def fold(self, number: int) -> Key:
        """Return a key that is independent of this one and of `fold(other)`. Use one number per view and per purpose."""
        return replace(self, stream=_mix(self.stream ^ _mix(number + 1)))

    def uint32(self) -> int:
        """Return the seed of this draw, in [0, 2**32)."""
        return _mix(_mix(_mix(self.seed & _MASK) ^ (self.step & _MASK)) ^ self.stream) >> 32
