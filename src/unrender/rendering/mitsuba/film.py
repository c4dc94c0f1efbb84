"""From pixels to camera rays, from path radiance back to pixels: each pixel has samples of its own, drawn by the film's filter.

Per-pixel statistics need pixels whose samples are their own, so a pixel is the mean of samples that lie where its reconstruction filter
puts them (`pixel_filter.py`); with a box filter, in its square.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.pixel_filter import PixelFilters


@dataclass
class RepeatingSampler:
    """Independent samples that are the same in every copy of an image: lane i shares its numbers with lane i + period.

    Stands for a `mitsuba.Sampler`; mutable, as that is, since it is state of the path tracer's loop.

    Attributes:
        period: lanes of one image.
        rng: `mitsuba.PCG32`, once seeded.
        lanes: `mi.UInt32`, the lane whose numbers each one is to have, in place of its own; None for its own.
    """

    period: int
    rng: Any = None
    lanes: Any = None

    def seed(self, seed: Any, lanes: int) -> None:
        """Start anew with `lanes` lanes."""
        lane = dr.arange(mi.UInt32, lanes) % self.period if self.lanes is None else self.lanes
        state, sequence = mi.sample_tea_32(seed, lane)  # pyright: ignore[reportCallIssue, reportArgumentType]
        self.rng = mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))  # pyright: ignore[reportCallIssue]

    def clone(self) -> RepeatingSampler:
        """Another with the same numbers to come."""
        return RepeatingSampler(self.period, mi.PCG32(self.rng), self.lanes)  # pyright: ignore[reportCallIssue]

    def wavefront_size(self) -> int:
        """Return the number of lanes."""
        return dr.width(self.rng)

    def next_1d(self, active: Any = True) -> Any:
        """A uniform number per lane, in lanes that are not active, too."""
        del active
        return self.rng.next_float32()

    def next_2d(self, active: Any = True) -> Any:
        """Two of them."""
        del active
        first = self.rng.next_float32()
        return mi.Point2f(first, self.rng.next_float32())


def independent(sampler: Any, lanes: int) -> RepeatingSampler:
    """Random numbers apart from those of the path, which is replayed and must meet its own again."""
    copy: Any = sampler.clone()
    bits: Any = dr.reinterpret_array(mi.UInt32, copy.next_1d())
    given = copy.lanes if isinstance(copy, RepeatingSampler) else None
    lane: Any = dr.arange(mi.UInt32, lanes) if given is None else given
    state, sequence = mi.sample_tea_32(bits, lane)
    rng: Any = mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))  # pyright: ignore[reportCallIssue]
    return RepeatingSampler(lanes, rng)


def _seed(sampler: Any, seed: Any, lanes: int) -> None:
    """Raises `InputError` for more lanes than Dr.Jit counts."""
    if lanes >= 1 << 32:
        raise InputError(f"{lanes} camera rays at once: a launch has less than 2³²; take fewer samples per pixel")
    sampler.seed(seed, lanes)


@dataclass(frozen=True)
class CameraSamples:
    """What a sensor makes camera rays of, per lane; samples of a pixel side by side.

    Attributes:
        sensor: `mitsuba.Sensor`, or `mitsuba.SensorPtr` where each pixel has its own.
        time: `mi.Float`.
        position: `mi.Point2f` on the film, from 0 to 1; beyond where the film samples its border.
        aperture: `mi.Point2f` in [0, 1).
        spp: rays per pixel.
        weight: `mi.Float`, of the reconstruction filter; None where all are 1.
    """

    sensor: Any
    time: Any
    position: Any
    aperture: Any
    spp: int
    weight: Any = None


def camera_samples(
    sensor: Any,
    sampler: Any,
    seed: Any,
    spp: int,
    pixels: Any,
    count: int,
    copies: int = 1,
    timed: bool = False,
    filters: PixelFilters | None = None,
    number: int = 0,
) -> CameraSamples:
    """Samples of one sensor's film; copies * count * spp lanes.

    Args:
        sensor: `mitsuba.Sensor`.
        sampler: `mitsuba.Sampler` ('independent'); seeded here.
        seed: `mi.UInt32` of width 1.
        spp: rays per pixel.
        pixels: `mi.UInt32` of flat indices, or None for all pixels in order.
        count: how many pixels.
        copies: of the whole image, one behind the other.
        timed: whether sensors open at different times (`open_at_different_times`): the time is then an input of the kernel, which all of
            them share, and no constant in it.
        filters: with this sensor's among them; None for a box filter.
        number: of this sensor's in `filters`.
    """
    film = sensor.film()
    width, height = int(film.crop_size()[0]), int(film.crop_size()[1])
    lanes = copies * count * spp
    _seed(sampler, seed, lanes)
    index = dr.arange(mi.UInt32, lanes) // spp
    if copies > 1:
        index %= count
    if pixels is not None:
        index = dr.gather(mi.UInt32, pixels, index)
    y = index // width
    position, weight = _positions(
        mi.Point2u(index - y * width, y), sampler, (width, height), filters, mi.UInt32(number)
    )
    opening = float(sensor.shutter_open())
    time = (dr.opaque(mi.Float, opening) if timed else opening) + (
        sampler.next_1d() * sensor.shutter_open_time() if sensor.shutter_open_time() > 0 else 0
    )
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    position = mi.Point2f(position.x / width, position.y / height)
    return CameraSamples(sensor, mi.Float(time), position, aperture, spp, weight)


def _positions(
    pixel: Any, sampler: Any, size: tuple[Any, Any], filters: PixelFilters | None, film: Any
) -> tuple[Any, Any]:
    """Positions in pixels, of samples of pixels by column and row, and the filter's weights, None for ones."""
    if filters is None:
        return mi.Point2f(pixel) + sampler.next_2d(), None
    u = sampler.next_2d()
    x, weight = filters.sample(u.x, pixel.x, size[0], film)
    y, of_row = filters.sample(u.y, pixel.y, size[1], film)
    return mi.Point2f(pixel.x + 0.5 + x, pixel.y + 0.5 + y), weight * of_row


def open_at_different_times(sensors: Any) -> bool:
    """Whether a list of `mitsuba.Sensor` has shutters that open at different times, such as those of a turntable."""
    return len({float(sensor.shutter_open()) for sensor in sensors}) > 1


def camera_samples_of_many(
    sensors: Any, films: Films, sampler: Any, seed: Any, spp: int, pixels: Any, count: int
) -> CameraSamples:
    """Samples of pixels that belong to different sensors; count * spp lanes.

    Args:
        sensors: `mitsuba.SensorPtr`, all of the scene's.
        films: of all of them, with the index of each pixel's sensor.
        sampler, seed, spp, pixels, count: see `camera_samples`.
    """
    lanes = count * spp
    _seed(sampler, seed, lanes)
    pixel, which = (per_sample(of_pixel, spp, count) for of_pixel in (pixels, films.which))
    width, height = dr.gather(mi.UInt32, films.widths, which), dr.gather(mi.UInt32, films.heights, which)
    # LLVM fills up its vectors with lanes that read 0, and dividing by that ends the process.
    y = pixel // dr.maximum(width, 1)
    position, weight = _positions(mi.Point2u(pixel - y * width, y), sampler, (width, height), films.filters, which)
    time = mi.Float(0)
    if films.shutters is not None:
        opening, open_time = films.shutters
        time = dr.gather(mi.Float, opening, which) + sampler.next_1d() * dr.gather(mi.Float, open_time, which)
    aperture = sampler.next_2d() if films.aperture else mi.Point2f(0.5)
    position = mi.Point2f(position.x / width, position.y / height)
    return CameraSamples(dr.gather(mi.SensorPtr, sensors, which), time, position, aperture, spp, weight)


def rays(samples: CameraSamples, hiding: Any = None) -> tuple[Any, Any]:
    """`mi.RayDifferential3f` and its weight per lane; `hiding`: the scene whose emitters are left out, or None."""
    ray, weight = samples.sensor.sample_ray_differential(samples.time, 0.5, samples.position, samples.aperture)
    ray.scale_differential(samples.spp**-0.5)
    weight = weight if samples.weight is None else weight * samples.weight
    return (ray, weight) if hiding is None else _past_emitters(hiding, ray, weight)


def _past_emitters(scene: Any, ray: Any, weight: Any) -> tuple[Any, Any]:
    """Camera rays from behind the emitters that they meet first, and their weights, 0 where they then meet nothing: `hide_emitters`."""

    def passing(o: Any, active: Any, meets: Any) -> Any:
        return active

    def step(o: Any, active: Any, meets: Any) -> tuple[Any, Any, Any]:
        onward = mi.Ray3f(ray)
        onward.o = o
        pi = scene.ray_intersect_preliminary(onward, coherent=True, active=active)
        meets = dr.select(active, pi.is_valid(), meets)
        active = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (of each lane)
        si = pi.compute_surface_interaction(onward, mi.RayFlags.Minimal, active)
        return dr.select(active, si.spawn_ray(onward.d).o, o), active, meets

    state = mi.Point3f(ray.o), dr.full(mi.Bool, True, dr.width(ray.d)), mi.Bool(False)
    loop: Any = dr.while_loop
    ray.o, _, meets = loop(state, passing, step, label="past emitters")
    return ray, dr.select(meets, weight, 0)


def sampler_at(positions: Any, spp: int, count: int) -> RepeatingSampler:
    """The sampler of a part of an image: each pixel has the numbers that it has as part of the whole.

    Args:
        positions: `mi.UInt32`, of each pixel in the whole.
        spp, count: of the part.
    """
    sample = dr.arange(mi.UInt32, count * spp) % spp
    return RepeatingSampler(count * spp, lanes=per_sample(positions, spp, count) * spp + sample)


def per_sample(of_pixel: Any, spp: int, count: int) -> Any:
    """`mi.UInt32` of each pixel, repeated for each of its samples: count to count * spp lanes."""
    return dr.gather(mi.UInt32, of_pixel, dr.arange(mi.UInt32, count * spp) // spp)


@dataclass(frozen=True)
class Films:
    """What rays of several sensors need to know of them.

    Attributes:
        widths, heights: of the films in pixels, `mi.UInt32`.
        aperture: whether any needs an aperture sample.
        shutters: opening times and durations, `mi.Float`; None where all are 0.
        filters: reconstruction filters; None where all are box filters.
        which: `mi.UInt32`, the index of each pixel's sensor; None where all pixels are one sensor's.
    """

    widths: Any
    heights: Any
    aperture: bool
    shutters: tuple[Any, Any] | None
    filters: PixelFilters | None = None
    which: Any = None

    @classmethod
    def of(cls, sensors: Any) -> Films:
        """Of a list of `mitsuba.Sensor`."""
        sizes = [sensor.film().crop_size() for sensor in sensors]
        times = [float(sensor.shutter_open_time()) for sensor in sensors]
        shutters = None
        openings = [float(sensor.shutter_open()) for sensor in sensors]
        if any(time != 0 for time in (*openings, *times)):
            shutters = mi.Float(openings), mi.Float(times)
        return cls(
            mi.UInt32([int(size[0]) for size in sizes]),
            mi.UInt32([int(size[1]) for size in sizes]),
            any(sensor.needs_aperture_sample() for sensor in sensors),
            shutters,
            PixelFilters.of(sensors),
        )


def develop(radiance: Any, spp: int, groups: int, shape: tuple[int, ...]) -> Any:
    """The mean of each pixel's samples, per group.

    Args:
        radiance: `mi.Spectrum`, evaluated, lanes ordered as `camera_samples` makes them.
        spp: samples per pixel, in all groups.
        groups: the samples of a pixel are cut into that many equal runs.
        shape: of one image, (H, W, 3) or (N, 3).

    Returns:
        `mi.TensorXf` (groups, *shape). Sums in a fixed order: equal seeds give equal bits.
    """
    size = spp // groups
    sums = [dr.block_sum(radiance[c], size) if size > 1 else radiance[c] for c in range(3)]
    count = dr.width(sums[0])
    pixels = count // groups
    index = dr.arange(mi.UInt32, count)
    group = index // pixels
    index = (index - group * pixels) * groups + group
    channels = mi.Color3f(*(dr.gather(mi.Float, sums[c], index) for c in range(3)))
    return mi.TensorXf(dr.ravel(channels) / size, (groups, *shape))  # pyright: ignore[reportOperatorIssue]


def film_adjoint(weights: Any, spp: int, count: int) -> Any:
    """The adjoint of `develop` averaged over the groups: each lane's share of its pixel's and group's weight.

    Args:
        weights: `mi.TensorXf` (groups, H, W, 3) or (groups, N, 3).
        spp: samples per pixel, in all groups.
        count: how many pixels.

    Returns:
        `mi.Spectrum` per lane: weights[group, pixel] / spp.
    """
    lane = dr.arange(mi.UInt32, count * spp)
    pixel = lane // spp
    group = (lane - pixel * spp) // (spp // weights.shape[0])
    index = (group * count + pixel) * 3
    return mi.Spectrum(*(dr.gather(mi.Float, weights.array, index + c) for c in range(3))) / spp
