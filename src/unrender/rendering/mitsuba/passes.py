"""The launches that answer a sample request, one class each: which scene is traced, with which tables, and what for.

A pass makes the function that is recorded. Its arguments after the first seven are the pass's own, see `trace`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.camera_paths import CameraPaths, Kernel, Tables, dropped_together
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.poses import Assembly, PosedScene
from unrender.rendering.mitsuba.scene_pair import ScenePair

Rays = list[tuple[Any, Any]]
"""(`mi.Ray3f`, `mi.Spectrum`): camera rays and their weights, of each state that is traced."""


@dataclass(frozen=True)
class LaunchSize:
    """What a kernel is compiled for.

    Attributes:
        sensor: its index; of no account where each pixel has its own.
        spp: samples per pixel.
        pixels: how many.
        hiding: whether emitters are left out where the camera sees them.
    """

    sensor: int
    spp: int
    pixels: int
    hiding: bool = False


class Pass(ABC):
    """One kind of launch. Equal passes have equal kernels."""

    previous: bool = False  # whether the previous scene is traced
    pair: ClassVar[bool] = False  # whether both states share the paths
    needs_tangents: ClassVar[bool] = False  # whether what the scene holds has tangents, which are an input

    def scene(self, pair: ScenePair) -> Any:
        """What is handed to the kernel as the scene."""
        return pair.loaded(self.previous).scene

    def states(self, pair: ScenePair) -> tuple[mi.Scene, ...]:
        """The scenes that camera rays are made for."""
        return (pair.loaded(self.previous).scene,)

    def numbers(self, sampler: mi.Sampler, size: LaunchSize, positions: mi.UInt32 | None) -> Any:
        """Where the random numbers come from, yet to be seeded."""
        # A sampler that is seeded already would die, and free memory, while the next kernel is recorded: clone one.
        return sampler.clone() if positions is None else film.sampler_at(positions, size.spp, size.pixels)

    def camera_rays(
        self, pair: ScenePair, sampler: mi.Sampler, size: LaunchSize, seeds: Any, pixels: Any, films: Any
    ) -> Rays:
        """The camera rays that `function` takes, made outside of it. Arguments: see `function`."""
        seed, positions = seeds
        found = []
        with dr.suspend_grad():
            for scene in self.states(pair):
                numbers = self.numbers(sampler, size, positions)
                samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                ray, weight = film.rays(samples, scene if size.hiding else None)
                found.append((mi.Ray3f(ray), weight))
        return found

    def tables(self, pair: ScenePair, delta: mi.UInt32, sensor: int | None) -> Tables:
        """The tables that the kernel looks up; `sensor`: None where each pixel has its own."""
        tables = self._surface_tables(pair, delta)
        if pair.volumetric:
            tables = {**tables, **pair.media(self.previous, sensor), **pair.majorants(self.previous, self.pair)}
        return tables

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {"delta": delta}

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """What is recorded: of the scene, all loaded scenes, tables, the seed with each pixel's position or None, pixels or None, the
        films (None for one sensor with a box filter), `camera_rays` or None to make them, and the pass's own arrays.

        With `posed`, what is handed as the scene is its `scenes()` and its `numbers()` of one pose, raveled.
        """

        def launch(scene, loaded, tables, seeds, pixels, films, rays, *own):
            del loaded  # read through pointers, if at all
            assembly = None
            if posed is not None:
                scenes, numbers_of_pose = scene
                assembly = posed.at(scenes, numbers_of_pose, mi.UInt32(0))
                scene = assembly.static
            seed, positions = seeds
            numbers = self.numbers(sampler, size, positions)
            with dr.suspend_grad():
                # Also where the rays are given: paths go on with the numbers after these.
                samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                made = film.rays(samples, scene if size.hiding else None) if rays is None else rays[0]
                ray, ray_weight = mi.Ray3f(made[0]) if rays else made[0], made[1]
                if assembly is not None:
                    ray = _posed_rays(assembly, ray, size, films)
                if films is not None and films.which is not None and "camera" in tables:
                    of_lane = film.per_sample(films.which, size.spp, size.pixels)
                    tables = {**tables, "camera": dr.gather(mi.UInt32, tables["camera"], of_lane)}
                paths = CameraPaths(kernel, scene, tables, numbers, ray, ray_weight, self.pair, assembly)
                return self.trace(paths, size, *own)

        return launch

    @abstractmethod
    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """Trace the camera rays.

        Args:
            paths: those that begin on the rays.
            size: what the kernel is compiled for.
            own: the pass's own arrays.
        """


@dataclass(frozen=True)
class ImagePass(Pass):
    """One state's radiance per lane."""

    previous: bool = False

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {}

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """The radiance of each lane."""
        return paths.radiance()[0]


@dataclass(frozen=True)
class ImagePairPass(Pass):
    """Both states' radiance per lane, on the current state's paths."""

    pair: ClassVar[bool] = True

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {**pair.tables(), "delta": delta}

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """The radiance of each lane, of the current and of the previous state."""
        return paths.radiance()


@dataclass(frozen=True)
class MovedPairPass(Pass):
    """Both states' radiance per lane where shapes move, on related paths.

    Attributes:
        moving: ids of the meshes that move.
        tracer: what traces both.
        still_sensors: whether both states have the same sensors.
    """

    moving: frozenset[str]
    tracer: MovedPair
    still_sensors: bool

    def scene(self, pair: ScenePair) -> Any:
        """Both."""
        return pair.current, pair.previous

    def states(self, pair: ScenePair) -> tuple[mi.Scene, ...]:
        """Both, or one where both have the same sensors."""
        return (pair.current,) if self.still_sensors else (pair.current, pair.previous)

    def tables(self, pair: ScenePair, delta: mi.UInt32, sensor: int | None) -> Tables:
        """See `MovedPair.sample`."""
        return pair.moved_tables(self.moving)

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """See `Pass.function`. Each state has the rays of its own sensors; the kernel is its own."""
        del kernel, posed

        def launch(scenes, loaded, tables, seeds, pixels, films, rays):
            del loaded
            seed, positions = seeds
            with dr.suspend_grad():
                made: list[tuple[Any, Any]] = []
                for state, scene in enumerate(scenes[: 1 if self.still_sensors else 2]):  # equal numbers
                    numbers: Any = self.numbers(sampler, size, positions)
                    samples = _camera_samples(scene, numbers, size, seed, pixels, films)
                    made.append(film.rays(samples) if rays is None else rays[state])
                choices = film.independent(numbers, size.pixels * size.spp)
                found = self.tracer.sample(scenes, tables, numbers, choices, (made[0][0], made[-1][0]))
                return dropped_together(found[0] * made[0][1], found[1] * made[-1][1])

        return launch

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """Never called: `function` traces both."""
        raise NotImplementedError


@dataclass(frozen=True)
class AdjointPass(Pass):
    """One state's path replay backward: accumulates the gradients of its leaves."""

    previous: bool = False

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> None:
        """`own`: the radiance that the primal pass returned, and the film's weights."""
        radiance, weights = own
        paths.backward((film.film_adjoint(weights, size.spp, size.pixels), radiance))


@dataclass(frozen=True)
class AdjointPairPass(Pass):
    """Both states' path replay backward, on the current state's paths.

    Attributes:
        both: whether the previous state's leaves get gradients, too.
    """

    both: bool = True
    pair: ClassVar[bool] = True

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {**pair.tables(), "delta": delta}

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> None:
        """`own`: as for `AdjointPass`, of the current and then of the previous state, whose weights are left out unless `both`."""
        radiance, weights, radianceₚ, *rest = own
        δL = film.film_adjoint(weights, size.spp, size.pixels)
        δLₚ = film.film_adjoint(rest[0], size.spp, size.pixels) if self.both else None
        paths.backward((δL, radiance), (δLₚ, radianceₚ))


@dataclass(frozen=True)
class TangentPass(Pass):
    """Path replay forward: the squared derivative of each lane's radiance along the tangents, of each channel or of their sum by the
    weights `combined`."""

    combined: tuple[float, ...] | None = None
    needs_tangents: ClassVar[bool] = True

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """`own`: the radiance that the primal pass returned."""
        (radiance,) = own
        found = paths.forward(radiance)
        return dr.square(found if self.combined is None else mi.Spectrum(dr.dot(mi.Spectrum(*self.combined), found)))


@dataclass(frozen=True)
class ConnectionsPass(Pass):
    """Path replay forward: what the connections of each lane's path to emitters tell.

    Attributes:
        bounces: connections of a path at most.
    """

    bounces: int
    needs_tangents: ClassVar[bool] = True

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """`own`: the radiance that the primal pass returned, and images' worth of weights, of the derivatives and of the radiance."""
        radiance, *given = own
        weights, noise = (film.film_adjoint(each, size.spp, size.pixels) for each in given)
        return paths.connections(radiance, weights, noise, self.bounces)


@dataclass(frozen=True)
class VerticesPass(Pass):
    """The number of vertices of each lane's path."""

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {}

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """As each channel of a spectrum, to be developed as one."""
        return mi.Spectrum(paths.vertices())


@dataclass(frozen=True, eq=False)
class PosesPass(Pass):
    """The radiance of many poses per lane, one image behind the other.

    Attributes:
        posed: the scene.
        copies: how many poses.
    """

    posed: PosedScene
    copies: int

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PosesPass) and self.posed is other.posed and self.copies == other.copies

    def __hash__(self) -> int:
        return hash((id(self.posed), self.copies))

    def scene(self, pair: ScenePair) -> Any:
        """Its static scene and those of the posed shapes."""
        return self.posed.scenes()

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> Tables:
        return {}

    def numbers(self, sampler: mi.Sampler, size: LaunchSize, positions: mi.UInt32 | None) -> Any:
        """The same for every pose."""
        del sampler, positions
        return film.RepeatingSampler(size.pixels * size.spp)

    def function(
        self, kernel: Kernel, sampler: mi.Sampler, size: LaunchSize, posed: PosedScene | None = None
    ) -> Callable[..., Any]:
        """See `Pass.function`; the pass's own array: of `PosedScene.numbers()`, raveled. `posed` is its own."""
        del posed

        def launch(scenes, loaded, tables, seeds, pixels, films, rays, numbers):
            del loaded, tables
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
                L, _ = kernel.sample(dr.ADMode.Primal, assembly.static, {}, repeating, ray, geometry=assembly)
                return L * ray_weight

        return launch

    def trace(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Any:
        """Never called: `function` traces all copies."""
        raise NotImplementedError


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
    """The rays of one image, one image behind the other."""
    lane = dr.arange(mi.UInt32, copies * lanes) % lanes
    return dr.gather(mi.Ray3f, rays[0], lane), dr.gather(mi.Spectrum, rays[1], lane)


def _posed_rays(assembly: Assembly, ray: Any, size: LaunchSize, films: film.Films | None) -> Any:
    """The rays of posed sensors where these stand; all others as they are."""
    which = None if films is None else films.which
    for index, sensor in enumerate(assembly.static.sensors()):
        if sensor.id() not in assembly.poses or (which is None and index != size.sensor):
            continue
        moved = assembly.poses[sensor.id()].ray_outside(ray)
        if which is None:
            return moved
        mine = film.per_sample(which, size.spp, size.pixels) == index
        ray.o, ray.d = dr.select(mine, moved.o, ray.o), dr.select(mine, moved.d, ray.d)
    return ray
