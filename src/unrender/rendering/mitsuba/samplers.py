"""Samplers of the random numbers of paths, in place of a `mitsuba.Sampler`. They are mutable, since they are state of the path's loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.film import per_sample


@dataclass
class RepeatingSampler:
    """Sampler of independent numbers that are equal in every copy of an image: lane i shares its numbers with lane i + period, or with that
    of `lanes`.

    It replaces a `mitsuba.Sampler`. It is mutable, as that is, since it is state of the path tracer's loop.
    """

    period: int
    rng: Any = None
    lanes: Any = None

    def seed(self, seed: Any, lanes: int) -> None:
        """Seed the generator for `lanes` lanes."""
        lane = dr.arange(mi.UInt32, lanes) % self.period if self.lanes is None else self.lanes
        state, sequence = mi.sample_tea_32(seed, lane)  # pyright: ignore[reportCallIssue, reportArgumentType]
        self.rng = mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))  # pyright: ignore[reportCallIssue]

    def clone(self) -> RepeatingSampler:
        """Return a sampler with the same future numbers."""
        return RepeatingSampler(self.period, mi.PCG32(self.rng), self.lanes)  # pyright: ignore[reportCallIssue]

    def wavefront_size(self) -> int:
        """Return the number of lanes."""
        return dr.width(self.rng)

    def next_1d(self, active: Any = True) -> Any:
        """Return a uniform number per lane, including inactive lanes."""
        return self.rng.next_float32()

    def next_2d(self, active: Any = True) -> Any:
        """Return two uniform numbers per lane, including inactive lanes."""
        first = self.rng.next_float32()
        return mi.Point2f(first, self.rng.next_float32())


@dataclass
class StratifiedSampler:
    """Sampler whose numbers are stratified over groups of lanes, such as the samples of a pixel.

    Each pair of numbers is of a randomised (0, 2)-sequence in random order. Numbers are uniform, and groups of `size` lanes are
    independent. So are the pairs of a lane. Copies of an image have equal numbers, see `RepeatingSampler`.
    """

    period: int
    size: int
    group: Any = None
    sample: Any = None
    pair: Any = None

    def seed(self, seed: Any, lanes: int) -> None:
        """Seed the generator for `lanes` lanes."""
        lane = dr.arange(mi.UInt32, lanes) % self.period
        self.group = mi.UInt32(mi.sample_tea_32(seed, lane // self.size)[0])  # pyright: ignore[reportCallIssue, reportArgumentType]
        self.sample, self.pair = lane % self.size, mi.UInt32(0)

    def clone(self) -> StratifiedSampler:
        """Return a sampler with the same future numbers."""
        return StratifiedSampler(self.period, self.size, self.group, self.sample, mi.UInt32(self.pair))

    def wavefront_size(self) -> int:
        """Return the number of lanes."""
        return dr.width(self.sample)

    def next_1d(self, active: Any = True) -> Any:
        """Return a uniform number per lane, including inactive lanes."""
        return self.next_2d(active).x

    def next_2d(self, active: Any = True) -> Any:
        """Return two uniform numbers per lane, including inactive lanes."""
        x, y = mi.sample_tea_32(self.group, self.pair, 8)  # with the default of 4 rounds, consecutive pairs are related
        order = mi.sample_tea_32(self.group, self.pair + (1 << 31), 8)
        self.pair = self.pair + 1
        index = _shuffled(self.sample, (self.size - 1).bit_length(), *order)
        return mi.Point2f(mi.radical_inverse_2(index, x), mi.sobol_2(index, y))


def _shuffled(index: Any, bits: int, first: Any, second: Any) -> Any:
    """Return indices below 2^`bits` in an order that two random numbers choose."""
    mask, half = (1 << bits) - 1, max(bits // 2, 1)
    for factor, offset in ((first | 1, second), (second | 1, first), ((first >> 16) | 1, second >> 16)):
        index = (index * factor + offset) & mask
        index = index ^ (index >> half)
    return index


def independent(sampler: Any, lanes: int) -> RepeatingSampler:
    """Return a sampler independent of the path's sampler, whose state does not change. A replay of the path sees the same numbers."""
    copy: Any = sampler.clone()
    bits: Any = dr.reinterpret_array(mi.UInt32, copy.next_1d())
    lanes_of_path = copy.lanes if isinstance(copy, RepeatingSampler) else None
    lane: Any = dr.arange(mi.UInt32, lanes) if lanes_of_path is None else lanes_of_path
    state, sequence = mi.sample_tea_32(bits, lane)
    rng: Any = mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))  # pyright: ignore[reportCallIssue]
    return RepeatingSampler(lanes, rng)


def sampler_at(positions: Any, spp: int, count: int) -> RepeatingSampler:
    """Return the sampler of a part of an image, in which each pixel has the same numbers as at its position in the full image."""
    sample = dr.arange(mi.UInt32, count * spp) % spp
    return RepeatingSampler(count * spp, lanes=per_sample(positions, spp, count) * spp + sample)
