"""Conversion of pixels to camera rays, of path radiance to pixels, and of weights of pixels to views. Each pixel has its own samples,
distributed by the film's filter.

Per-pixel statistics require samples that belong to one pixel. A pixel is therefore the mean of samples that are distributed according
to its reconstruction filter (`pixel_filter.py`). The samples of a box filter are uniform in the pixel's square.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.pixel_filter import PixelFilters
from unrender.rendering.renderer import SampleRequest


def _seed(sampler: Any, seed: Any, lanes: int) -> None:
    if lanes >= 1 << 32:
        raise InputError(f"{lanes} camera rays: a launch is limited to fewer than 2³²; reduce the samples per pixel")
    sampler.seed(seed, lanes)


@dataclass(frozen=True)
class CameraSamples:
    """Arguments of `mitsuba.Sensor.sample_ray_differential` per lane. Samples of a pixel are adjacent.

    Attributes:
        sensor: `mitsuba.Sensor`, or `mitsuba.SensorPtr` if each pixel has its own.
        time: `mi.Float`.
        position: `mi.Point2f` on the film, from 0 to 1; beyond if the film samples its border.
        aperture: `mi.Point2f` in [0, 1).
        spp: rays per pixel.
        weight: `mi.Float`, weight of the reconstruction filter; None if all weights are 1.
        wavelength: number in [0, 1) that the wavelengths are sampled with; not used in RGB variants.
    """

    sensor: Any
    time: Any
    position: Any
    aperture: Any
    spp: int
    weight: Any = None
    wavelength: Any = 0.5


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
    """Return samples of one sensor's film, or of its flat `pixels`, in `copies` concatenated images; copies * count * spp lanes.

    The sampler is seeded here. The time of sensors that open at different times (`timed`) is an input of the shared kernel instead of a
    constant. `number` is the index of this sensor in `filters`, which are None for a box filter.
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
    return CameraSamples(sensor, mi.Float(time), position, aperture, spp, weight, _wavelength(sampler))


def _wavelength(sampler: Any) -> Any:
    return sampler.next_1d() if is_spectral() else 0.5


def _positions(
    pixel: Any, sampler: Any, size: tuple[Any, Any], filters: PixelFilters | None, film: Any
) -> tuple[Any, Any]:
    """Return film positions in pixels for samples of pixels (column, row), and the filter's weights, None for ones."""
    if filters is None:
        return mi.Point2f(pixel) + sampler.next_2d(), None
    u = sampler.next_2d()
    x, weight = filters.sample(u.x, pixel.x, size[0], film)
    y, of_row = filters.sample(u.y, pixel.y, size[1], film)
    return mi.Point2f(pixel.x + 0.5 + x, pixel.y + 0.5 + y), weight * of_row


def open_at_different_times(sensors: Any) -> bool:
    """Return whether the shutters of a list of `mitsuba.Sensor` open at different times, such as those of a turntable."""
    return len({float(sensor.shutter_open()) for sensor in sensors}) > 1


def camera_samples_of_many(
    sensors: Any, films: Films, sampler: Any, seed: Any, spp: int, pixels: Any, count: int
) -> CameraSamples:
    """Return samples of pixels that belong to different sensors, with one seed or the seed of each pixel; count * spp lanes. See
    `camera_samples`."""
    lanes = count * spp
    pixel, which = (per_sample(of_pixel, spp, count) for of_pixel in (pixels, films.which))
    _seed(sampler, seed if dr.width(seed) == 1 else per_sample(seed, spp, count), lanes)
    width, height = dr.gather(mi.UInt32, films.widths, which), dr.gather(mi.UInt32, films.heights, which)
    # LLVM pads its vectors with lanes that read 0. A division by this 0 would abort the process.
    y = pixel // dr.maximum(width, 1)
    position, weight = _positions(mi.Point2u(pixel - y * width, y), sampler, (width, height), films.filters, which)
    time = mi.Float(0)
    if films.shutters is not None:
        opening, open_time = films.shutters
        time = dr.gather(mi.Float, opening, which) + sampler.next_1d() * dr.gather(mi.Float, open_time, which)
    aperture = sampler.next_2d() if films.aperture else mi.Point2f(0.5)
    position = mi.Point2f(position.x / width, position.y / height)
    sensor = dr.gather(mi.SensorPtr, sensors, which)
    return CameraSamples(sensor, time, position, aperture, spp, weight, _wavelength(sampler))


def rays(samples: CameraSamples, hidden_in: Any = None) -> tuple[Any, Any]:
    """Return `mi.RayDifferential3f` and its weight per lane.

    If `hidden_in` is a scene, rays begin behind its directly visible emitters. A ray that hits nothing else has the weight 0.
    """
    ray, weight = samples.sensor.sample_ray_differential(
        samples.time, samples.wavelength, samples.position, samples.aperture
    )
    ray.scale_differential(samples.spp**-0.5)
    weight = weight if samples.weight is None else weight * samples.weight
    return (ray, weight) if hidden_in is None else _past_emitters(hidden_in, ray, weight)


def _past_emitters(scene: Any, ray: Any, weight: Any) -> tuple[Any, Any]:
    """Move camera rays behind the emitters that they hit first (`hide_emitters`). Rays without a further hit have weight 0."""

    def passing(o: Any, active: Any, meets: Any) -> Any:
        return active

    def step(o: Any, active: Any, meets: Any) -> tuple[Any, Any, Any]:
        onward = mi.Ray3f(ray)
        onward.o = o
        pi = scene.ray_intersect_preliminary(onward, coherent=True, active=active)
        meets = dr.select(active, pi.is_valid(), meets)
        active = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (per lane)
        si = pi.compute_surface_interaction(onward, mi.RayFlags.Minimal, active)
        return dr.select(active, si.spawn_ray(onward.d).o, o), active, meets

    state = mi.Point3f(ray.o), dr.full(mi.Bool, True, dr.width(ray.d)), mi.Bool(False)
    loop: Any = dr.while_loop
    ray.o, _, meets = loop(state, passing, step, label="past emitters")
    return ray, dr.select(meets, weight, 0)


def per_sample(of_pixel: Any, spp: int, count: int) -> Any:
    """Repeat each pixel's `mi.UInt32` for each of its samples: from count to count * spp lanes."""
    return dr.gather(mi.UInt32, of_pixel, dr.arange(mi.UInt32, count * spp) // spp)


@dataclass(frozen=True)
class Films:
    """Data of several sensors' films that their camera rays need.

    Attributes:
        widths, heights: film sizes in pixels, `mi.UInt32`.
        aperture: whether any sensor needs an aperture sample.
        shutters: opening times and durations, `mi.Float`; None if all are 0.
        filters: reconstruction filters; None if all are box filters.
        which: `mi.UInt32`, index of each pixel's sensor; None if all pixels belong to one sensor.
    """

    widths: Any
    heights: Any
    aperture: bool
    shutters: tuple[Any, Any] | None
    filters: PixelFilters | None = None
    which: Any = None

    @classmethod
    def of(cls, sensors: Any) -> Films:
        """Return the data of a list of `mitsuba.Sensor`."""
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
    """Return the mean of each pixel's samples, per group: `mi.TensorXf` (groups, *shape).

    `radiance` has evaluated samples, lanes in the order of `camera_samples`. Groups are equal and contiguous. Sums have a fixed order:
    equal seeds give equal bits.
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
    """Return the adjoint of `develop` averaged over the groups: weights[group, pixel] / spp of each lane, for weights (groups, H, W, 3) or
    (groups, N, 3)."""
    lane = dr.arange(mi.UInt32, count * spp)
    pixel = lane // spp
    group = (lane - pixel * spp) // (spp // weights.shape[0])
    index = (group * count + pixel) * 3
    return mi.Color3f(*(dr.gather(mi.Float, weights.array, index + c) for c in range(3))) / spp


@dataclass(frozen=True)
class ViewWeights:
    """Pixels of one sensor.

    Attributes:
        image: `mi.TensorXf` (H, W, 3), derivative of the loss by each element of the image; 0 at pixels that were not requested.
        pixels: `mi.UInt32`, flat indices of the requested pixels; one may occur twice.
        values: `mi.Float` (3 N,), weights of these pixels, mean over groups.
        rows: `mi.UInt32`, indices of these pixels in the request.
        spp: samples per pixel.
    """

    sensor: int
    image: Any
    pixels: Any
    values: Any
    rows: Any
    spp: int

    @property
    def samples(self) -> int:
        """Number of samples of all its pixels."""
        return dr.width(self.pixels) * self.spp


def views_of(
    request: SampleRequest, weights: mi.TensorXf, resolutions: Sequence[tuple[int, int]]
) -> Iterator[ViewWeights]:
    """Yield the views that a request has pixels of, with weights of `RenderSession.adjoint`, averaged over groups."""
    groups = weights.shape[0]
    size = dr.width(weights.array) // groups
    lane = dr.arange(mi.UInt32, size)
    mean = mi.Float(0)
    for group in range(groups):
        mean += dr.gather(mi.Float, weights.array, lane + group * size)
    mean /= groups
    dr.eval(mean)
    if request.pixels is None:
        shape = (*resolutions[request.sensor], 3)
        pixels = dr.arange(mi.UInt32, size // 3)
        yield ViewWeights(request.sensor, mi.TensorXf(mean, shape), pixels, mean, pixels, request.spp)
        return
    which = np.full(size // 3, request.sensor) if request.sensors is None else np.array(request.sensors)
    for sensor in np.unique(which).tolist():
        height, width = resolutions[sensor]
        own = mi.UInt32(np.flatnonzero(which == sensor).astype(np.uint32))
        pixels = dr.gather(mi.UInt32, request.pixels, own)
        element = dr.arange(mi.UInt32, 3 * dr.width(own))
        values = dr.gather(mi.Float, mean, dr.gather(mi.UInt32, own, element // 3) * 3 + element % 3)
        image = dr.zeros(mi.Float, height * width * 3)
        dr.scatter_add(image, values, dr.gather(mi.UInt32, pixels, element // 3) * 3 + element % 3)
        yield ViewWeights(int(sensor), mi.TensorXf(image, (height, width, 3)), pixels, values, own, request.spp)
