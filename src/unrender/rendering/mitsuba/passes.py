"""Kernel launches that serve a sample request, one class each: the traced scene, its tables, and the result.

A pass builds the function that is recorded. Its arguments after the first seven belong to the pass, see `call`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba import film, samplers
from unrender.rendering.mitsuba.camera_paths import CameraPaths, Kernel, Tables, dropped_together
from unrender.rendering.mitsuba.film_response import FilmResponse, response_table
from unrender.rendering.mitsuba.integrators.base import PathContext
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.poses import Assembly, PosedScene
from unrender.rendering.mitsuba.scene_pair import ScenePair

Rays = list[tuple[Any, Any]]
"""(`mi.Ray3f`, `mi.Spectrum`): camera rays and their weights, for each traced state."""


@dataclass(frozen=True)
class LaunchSize:
    """Constants that a kernel is compiled for. `hiding`: emitters are invisible to camera rays. `strata`: number of adjacent samples that
    are stratified together, 1 for independent ones."""

    sensor: int
    spp: int
    pixels: int
    hiding: bool = False
    strata: int = 1


class Pass:
    """One kind of launch. Equal passes have equal kernels."""

    previous: bool = False  # whether the previous scene is traced
    pair: ClassVar[bool] = False  # whether both states share the paths
    needs_tangents: ClassVar[bool] = False  # whether the scene's state has tangents, which are an input
    needs_delta_table: ClassVar[bool] = True  # whether perfectly specular lobes are looked up

    def scene(self, pair: ScenePair) -> Any:
        """Return the scene argument of the kernel."""
        return pair.loaded(self.previous).scene

    def states(self, pair: ScenePair) -> tuple[mi.Scene, ...]:
        """Return the scenes whose sensors generate camera rays."""
        return (pair.loaded(self.previous).scene,)

    def numbers(self, sampler: mi.Sampler, size: LaunchSize, positions: mi.UInt32 | None) -> Any:
        """Return the unseeded sampler."""
        if size.strata > 1 and positions is None:
            return samplers.StratifiedSampler(size.pixels * size.spp, size.strata)
        # Clone the sampler: a seeded one would be destroyed, and free memory, while the next kernel is recorded.
        return sampler.clone() if positions is None else samplers.sampler_at(positions, size.spp, size.pixels)

    def camera_rays(
        self, pair: ScenePair, sampler: mi.Sampler, size: LaunchSize, seeds: Any, pixels: Any, films: Any
    ) -> Rays:
        """Return the camera rays that `function` accepts, generated outside of it. For the arguments, see `function`."""
        seed, positions = seeds
        result = []
        with dr.suspend_grad():
            for scene in self.states(pair):
                numbers = self.numbers(sampler, size, positions)
                samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                ray, weight = film.rays(samples, scene if size.hiding else None)
                result.append((mi.Ray3f(ray), weight))
        return result

    def tables(self, pair: ScenePair, delta: mi.UInt32, sensor: int | None) -> Tables:
        """Return the tables that the kernel looks up. `sensor` is None if each pixel has its own."""
        tables = {**self._surface_tables(pair, delta), **response_table()}
        if pair.volumetric:
            tables = {**tables, **pair.media(self.previous, sensor), **pair.majorants(self.previous, self.pair)}
        return tables

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        own = {"delta": delta} if self.needs_delta_table else {}
        return {**pair.tables(), **own} if self.pair else own

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """Return the function to record.

        Its arguments are the scene, all loaded scenes, the tables, (the seed, each pixel's position or None), pixels or None, the films
        (None for one sensor with a box filter), `camera_rays` or None to generate them, and the pass's own arrays. With `posed`, the
        scene argument consists of its `scenes()` and its raveled `numbers()` of one pose.
        """

        def launch(scene, loaded, tables, seeds, pixels, films, rays, *own):
            del loaded  # accessed by virtual calls only
            assembly = None
            if posed is not None:
                scenes, numbers_of_pose = scene
                assembly = posed.at(scenes, numbers_of_pose, mi.UInt32(0))
                scene = assembly.static
            seed, positions = seeds
            numbers = self.numbers(sampler, size, positions)
            with dr.suspend_grad():
                # Required even for precomputed rays, since it advances the sampler to the paths' numbers.
                samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                generated = film.rays(samples, scene if size.hiding else None) if rays is None else rays[0]
                ray, ray_weight = mi.Ray3f(generated[0]) if rays else generated[0], generated[1]
                if assembly is not None:
                    ray = _posed_rays(assembly, ray, size, films)
                if films is not None and films.which is not None and "camera" in tables:
                    of_lane = film.per_sample(films.which, size.spp, size.pixels)
                    tables = {**tables, "camera": dr.gather(mi.UInt32, tables["camera"], of_lane)}
                paths = CameraPaths(kernel, scene, tables, numbers, ray, ray_weight, self.pair, assembly)
                trace = self.call(paths, size, *own)
                return self.result(paths, trace())

        return launch

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        """Return the call that traces the camera rays, by default without derivatives; `own` are the pass's own arrays."""
        return paths.primal()

    def result(self, paths: CameraPaths, output: Any) -> Any:
        """Return the result of the launch from the output of `call`."""
        return None


@dataclass(frozen=True)
class ImagePass(Pass):
    """Radiance of one state per lane."""

    previous: bool = False
    needs_delta_table = False

    def result(self, paths: CameraPaths, output: Any) -> Any:
        return paths.weighted(*output)[0]


@dataclass(frozen=True)
class ImagePairPass(Pass):
    """Radiance of both states per lane, on the current state's paths."""

    pair: ClassVar[bool] = True

    def result(self, paths: CameraPaths, output: Any) -> Any:
        return paths.weighted(*output)


@dataclass(frozen=True)
class MovedPairPass(Pass):
    """Radiance of both states per lane on related paths, for moving meshes. The sensors of both may be equal (`still_sensors`)."""

    moving: frozenset[str]
    tracer: MovedPair
    still_sensors: bool

    def scene(self, pair: ScenePair) -> Any:
        return pair.current, pair.previous

    def states(self, pair: ScenePair) -> tuple[mi.Scene, ...]:
        return (pair.current,) if self.still_sensors else (pair.current, pair.previous)

    def tables(self, pair: ScenePair, delta: mi.UInt32, sensor: int | None) -> Tables:
        return pair.moved_tables(self.moving)

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """Return the function to record. Each state has the rays of its own sensors, and `tracer` replaces the kernel."""

        def launch(scenes, loaded, tables, seeds, pixels, films, rays):
            seed, positions = seeds
            with dr.suspend_grad():
                generated: list[tuple[Any, Any]] = []
                for state, scene in enumerate(scenes[: 1 if self.still_sensors else 2]):  # equal random numbers
                    numbers: Any = self.numbers(sampler, size, positions)
                    samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                    generated.append(film.rays(samples) if rays is None else rays[state])
                choices = samplers.independent(numbers, size.pixels * size.spp)
                radiance = self.tracer.sample(scenes, tables, numbers, choices, (generated[0][0], generated[-1][0]))
                return dropped_together(radiance[0] * generated[0][1], radiance[1] * generated[-1][1])

        return launch


@dataclass(frozen=True)
class AdjointPass(Pass):
    """Backward path replay of one state, which accumulates the gradients of its leaves."""

    previous: bool = False

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        """Replay the paths backward. `own`: radiance of the primal pass, and the film's weights."""
        radiance, weights = own
        return paths.backward((film.film_adjoint(weights, size.spp, size.pixels), radiance))


@dataclass(frozen=True)
class AdjointPairPass(Pass):
    """Backward path replay of both states, on the current state's paths; gradients accumulate in `both` or in the current state alone."""

    both: bool = True
    pair: ClassVar[bool] = True

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        """Replay the paths backward. `own`: radiance and weights of the current, then of the previous state, without its weights unless
        `both`."""
        radiance, weights, radianceₚ, *rest = own
        δL = film.film_adjoint(weights, size.spp, size.pixels)
        δLₚ = film.film_adjoint(rest[0], size.spp, size.pixels) if self.both else None
        return paths.backward((δL, radiance), (δLₚ, radianceₚ))


@dataclass(frozen=True)
class TangentPass(Pass):
    """Forward path replay: the squared derivative along the tangents of each lane's radiance, or of its sum with the weights `combined`."""

    combined: tuple[float, ...] | None = None
    needs_tangents: ClassVar[bool] = True

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        """Replay the paths forward. `own`: radiance of the primal pass."""
        (radiance,) = own
        return paths.forward(radiance)

    def result(self, paths: CameraPaths, output: Any) -> Any:
        derivative = paths.response.film(output[0])
        return dr.square(
            derivative if self.combined is None else mi.Color3f(dr.dot(mi.Color3f(*self.combined), derivative))
        )


@dataclass(frozen=True)
class ConnectionsPass(Pass):
    """Forward path replay: values of the emitter-sampling connections of each lane's path, at most `bounces`."""

    bounces: int
    needs_tangents: ClassVar[bool] = True

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        """Record the connections. `own`: radiance of the primal pass, image weights of derivatives, and of radiance."""
        radiance, *image_weights = own
        weights, noise = (film.film_adjoint(each, size.spp, size.pixels) for each in image_weights)
        return paths.connections(radiance, weights, noise, self.bounces)

    def result(self, paths: CameraPaths, output: Any) -> Any:
        return output.values, output.emitters


@dataclass(frozen=True)
class VerticesPass(Pass):
    """Number of vertices of each lane's path."""

    needs_delta_table = False

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        return paths.vertices()

    def result(self, paths: CameraPaths, output: Any) -> Any:
        """Return the number of vertices in each channel of a colour, to be developed like samples of the film."""
        return mi.Color3f(output)


@dataclass(frozen=True, eq=False)
class PosesPass(Pass):
    """Radiance of many poses per lane, as concatenated images."""

    posed: PosedScene
    copies: int
    needs_delta_table = False

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PosesPass) and self.posed is other.posed and self.copies == other.copies

    def __hash__(self) -> int:
        return hash((id(self.posed), self.copies))

    def scene(self, pair: ScenePair) -> Any:
        return self.posed.scenes()

    def numbers(self, sampler: mi.Sampler, size: LaunchSize, positions: mi.UInt32 | None) -> Any:
        """Return a sampler whose numbers are equal for every pose."""
        if size.strata > 1:
            return super().numbers(sampler, size, positions)
        return samplers.RepeatingSampler(size.pixels * size.spp)

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """Return the function to record. The pass's own array is the raveled `PosedScene.numbers()`. It uses its own `posed`."""

        def launch(scenes, loaded, tables, seeds, pixels, films, rays, numbers):
            seed, positions = seeds
            lanes = size.pixels * size.spp
            batch = dr.arange(mi.UInt32, self.copies * lanes) // lanes
            assembly = self.posed.at(scenes, numbers, batch)
            repeating = self.numbers(sampler, size, positions)
            with dr.suspend_grad():
                cameras = assembly.static.sensors()
                camera = cameras[size.sensor]
                samples = _samples_of_one(cameras, repeating, size, seed, pixels, films, self.copies)
                ray, ray_weight = film.rays(samples) if rays is None else _repeated(rays[0], lanes, self.copies)
                if camera.id() in assembly.poses:
                    ray = assembly.poses[camera.id()].ray_outside(ray)
                context = PathContext(dr.ADMode.Primal, assembly.static, {}, geometry=assembly)
                L, _ = kernel.sample(context, repeating, ray)
                return FilmResponse(ray_weight, ray.wavelengths, tables).film(L)

        return launch


def _camera_samples(
    scene: mi.Scene, sampler: Any, size: LaunchSize, seed: mi.UInt32, pixels: mi.UInt32 | None, films: film.Films | None
) -> film.CameraSamples:
    if films is None or films.which is None:
        return _samples_of_one(scene.sensors(), sampler, size, seed, pixels, films)
    return film.camera_samples_of_many(scene.sensors_dr(), films, sampler, seed, size.spp, pixels, size.pixels)


def _samples_of_one(
    cameras: Any, sampler: Any, size: LaunchSize, seed: Any, pixels: Any, films: film.Films | None, copies: int = 1
) -> film.CameraSamples:
    timed, filters = film.open_at_different_times(cameras), None if films is None else films.filters
    of_sensor = cameras[size.sensor], sampler, seed, size.spp, pixels, size.pixels
    return film.camera_samples(*of_sensor, copies, timed, filters, size.sensor)


def _repeated(rays: tuple[mi.Ray3f, mi.Spectrum], lanes: int, copies: int) -> tuple[Any, Any]:
    lane = dr.arange(mi.UInt32, copies * lanes) % lanes
    return dr.gather(mi.Ray3f, rays[0], lane), dr.gather(mi.Spectrum, rays[1], lane)


def _posed_rays(assembly: Assembly, ray: Any, size: LaunchSize, films: film.Films | None) -> Any:
    """Transform the rays of posed sensors to world space. Other rays do not change."""
    which = None if films is None else films.which
    for index, sensor in enumerate(assembly.static.sensors()):
        if sensor.id() not in assembly.poses or (which is None and index != size.sensor):
            continue
        moved = assembly.poses[sensor.id()].ray_outside(ray)
        if which is None:
            return moved
        is_own = film.per_sample(which, size.spp, size.pixels) == index
        ray.o, ray.d = dr.select(is_own, moved.o, ray.o), dr.select(is_own, moved.d, ray.d)
    return ray
