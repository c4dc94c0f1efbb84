"""Renderer protocols: everything that the methods may use of a renderer.

`rendering/mitsuba/` implements them with Mitsuba, `gallery/analytic.py` with known integrals and gradients. Arrays are the renderer's own
(`mi.TensorXf`, `np.ndarray`). Parameters are dictionaries {key: array} and are never changed in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.io.parameter_values import PLAIN, FileConversion
from unrender.rendering.parameter_errors import Role

Space = Literal["path", "primary"]
"""Sample space that two states share: "path" for one set of paths, "primary" for one set of random numbers."""

Derivatives = bool | AbstractSet[str]
"""Whether derivatives will be requested, or the keys of the parameters whose derivatives will be."""
LossWeights = Callable[[Array], Array]
"""Function from an image (H, W, 3) to the derivative of the loss by each of its elements."""


@dataclass(frozen=True)
class ParameterInfo:
    """Description of a renderer's parameter.

    Attributes:
        differentiable: whether `adjoint` can return its gradient.
        shares_paths: whether two values of it can share one set of paths (path space); paths of a moving mesh are related, not equal.
        reason: reason why it is not differentiable or cannot share paths; else "".
        lowest, highest: physical limits of the values, or None.
        singular: value between these limits where images are singular, such as an index of refraction of 1; it is never crossed.
        perturbable, compiled: whether `image_batch` can render other values; whether it is a plain number compiled into kernels.
        rigid, light: whether it moves a shape, light or sensor rigidly, with many minima of the loss; whether that is a light.
        viewpoint, sensor: whether it is a sensor's pose or lens parameter; index of the only sensor that it changes, or None.
        mesh: for values (n V,) at the V vertices of a mesh, function that returns its loaded positions (V, 3) and faces (F, 3); else None.
        welded: whether the values are vertex positions, shared by vertices at the same position.
        resizable: whether it may be rendered at resolutions other than its own, (H, W, C) or (Z, Y, X, C).
        conversion: conversion of a file's values when the renderer loads such a parameter.
        role: meaning of the values: numbers, heights, normals or directions. The errors of the last two are angles.
        brightness: quantity that the picture is proportional to: "light" of an emitter, "reflectance" of a surface; else "".
        nonlinear: whether it changes the form of the picture, not its brightness: positions, lenses, skies, indices of refraction.
        scattering: what it changes the form of: a "bsdf", as a roughness does, not a colour, or a "medium"; else "".
        length: order of magnitude of lengths at the object that it moves, a power of ten; 1 for other values.
        angle, axial: whether its values are angles in radians; whether they turn a light whose own axis no picture shows.
        forward: direction in which the sensor, spotlight or projector that it turns looks as loaded, in world space; else None.
        lobe: whether it decides the probability of a lobe, which is never sampled if all values are at an end of the range.
        of_expression: whether expressions read it, which may be nonlinear.
        shown: whether images can depend on it, as depths cannot on a colour.
    """

    shape: tuple[int, ...]
    differentiable: bool = True
    shares_paths: bool = True
    reason: str = ""
    lowest: float | None = None
    highest: float | None = None
    singular: float | None = None
    perturbable: bool = True
    compiled: bool = False
    resizable: bool = False
    rigid: bool = False
    light: bool = False
    viewpoint: bool = False
    sensor: int | None = None
    mesh: Callable[[], tuple[np.ndarray, np.ndarray]] | None = field(default=None, compare=False, repr=False)
    welded: bool = False
    conversion: FileConversion = PLAIN
    role: Role = "value"
    brightness: Literal["", "light", "reflectance"] = ""
    nonlinear: bool = False
    scattering: Literal["", "bsdf", "medium"] = ""
    angle: bool = False
    axial: bool = False
    forward: tuple[float, ...] | None = None
    lobe: bool = False
    of_expression: bool = False
    length: float = 1.0
    shown: bool = True

    @property
    def curved(self) -> bool:
        """True for a texture or grid of which the picture is no linear function, such as a roughness, a normal map or a weight.

        Those that expressions read count as such.
        """
        return self.of_expression or (self.resizable and not self.brightness)

    @property
    def shape_pose(self) -> bool:
        """True for a coordinate of the pose of a shape that is no light."""
        return self.rigid and not (self.light or self.viewpoint)

    @property
    def moving_mesh(self) -> Callable[[], tuple[np.ndarray, np.ndarray]] | None:
        """`mesh` if the values are its vertex positions; else None."""
        return self.mesh if self.welded else None


@dataclass(frozen=True)
class SampleRequest:
    """Request for samples of a sensor's pixels.

    Attributes:
        spp: samples per pixel of all groups together; a multiple of `groups`.
        seed: integer in [0, 2**32), from `Key.uint32()`.
        groups: number of independent images that the samples are split into.
        pixels: flat pixel indices (row-major), or None for the full film.
        sensors: sensor index of each chosen pixel, in place of `sensor`; None if all pixels are of `sensor`.
        positions: index of each chosen pixel in its mini-batch, which selects its random numbers: part of a mini-batch has the same
            samples as the full one. None if the chosen pixels are the full mini-batch.
        emitters: probability of each emitter in emitter sampling, (E,), sum 1, see `EmitterSession`; None for the scene's own.
        both_gradients: for a pair, whether `adjoint_pair` will be called, not `adjoint` alone. False saves memory and time.
        seeds: seed of each chosen pixel in place of `seed`, with `sensors` and `positions`; for renderers with `joins_views` only.
        stratified: whether the random numbers of each group of a pixel are stratified, which has less noise. Pixels and groups remain
            independent. Renderers may ignore it, and mini-batches do.
    """

    sensor: int
    spp: int
    seed: int
    groups: int = 1
    pixels: Array | None = None
    sensors: Array | None = None
    positions: Array | None = None
    emitters: np.ndarray | None = None
    both_gradients: bool = False
    seeds: Array | None = None
    stratified: bool = False


@dataclass(frozen=True)
class Rendering:
    """Result of a `SampleRequest`.

    Attributes:
        images: mean of each group's samples: (groups, H, W, 3), or (groups, N, 3) for N chosen pixels.
        previous: same shape, for the previous parameters on the same samples; None unless a pair was requested.
        paths: renderer-specific data that `adjoint` needs to replay the same paths.
    """

    images: Array
    previous: Array | None
    paths: Any


def differentiated(keys: Iterable[str], derivatives: Derivatives) -> frozenset[str]:
    """Return the keys among `keys` that the argument `derivatives` of `Renderer.prepare` selects."""
    known = frozenset(keys)
    return known & (derivatives if not isinstance(derivatives, bool) else known if derivatives else frozenset())


class RenderSession(Protocol):
    """Images and derivatives with respect to the parameters that `Renderer.prepare` received.

    Methods are pure: equal arguments give bitwise equal results, whatever was rendered in between by this session or another of the
    same renderer. Arguments do not change. Where float atomics leave the order of a sum undefined, its last bits are undefined too. An
    omitted parameter has the scene's own value and no derivative.
    """

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """Render an unbiased image of each group."""
        ...

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """Render many states {key: (B, *shape)}, NumPy, with the same random numbers to unbiased images (B, H, W, 3), in one group.

        An array that is broadcast along its first axis (`numpy.broadcast_to`) is equal in all states; a renderer may then use fewer
        launches.
        """
        ...

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render unbiased images of two states with the same paths (`"path"`) or the same random numbers (`"primary"`). If shapes move,
        the paths are related, not equal."""
        ...

    def adjoint(self, parameters: Tree, paths: Any, weights: Array) -> Tree:
        """Return the gradient of the mean over groups g of sum(weights[g] * images[g]), on the paths of a rendering.

        `weights` has the shape of the images. The gradient is unbiased if `weights[g]` is independent of group g.
        """
        ...

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """Return `adjoint` of both states of an `image_pair`, on its paths and in its space: by `current` for `weights`, and by
        `previous` for `weights_previous`. If shapes move, the previous state's uses paths from the same random numbers."""
        ...

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> Array:
        """Return the mean over a pixel's samples of (Σ_k v_k ∂f/∂θ_k)² for the tangents v, on the paths of a rendering.

        The result has the shape of the images if there are several groups, each from its own samples. It has the shape of one image if
        there is one group. For independent tangents of ±1, its expectation is Σ_k E[(∂f/∂θ_k)²], the second moment of all
        single-parameter derivatives of a path. If `adjoint` includes a boundary term of moving silhouettes, the square of the pixel's
        estimate of it is added, noise included.
        """
        ...


@runtime_checkable
class CountingSession(Protocol):
    """A session that can count the vertices of its paths."""

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """Return each pixel's mean number of path vertices, without the camera's, in the shape of one image with equal channels. A path
        without an intersection has 0 vertices."""
        ...


@dataclass(frozen=True)
class EmitterMoments:
    """Moments of the emitter-sampling connections of paths: sums over connections of a value y each, by the sampled emitter.

    Attributes:
        sums: Σ y, float64 (E,).
        squares: Σ y², float64 (E,).
    """

    sums: np.ndarray
    squares: np.ndarray

    def __add__(self, other: EmitterMoments) -> EmitterMoments:
        return EmitterMoments(self.sums + other.sums, self.squares + other.squares)


@runtime_checkable
class EmitterSession(Protocol):
    """A session whose emitter sampling accepts the probabilities of a `SampleRequest`. Images and gradients are as unbiased as with the
    scene's own probabilities, if no contributing emitter has probability 0."""

    def emitters(self) -> np.ndarray:
        """Return the scene's own probabilities of its E emitters, (E,), sum 1. Raise `InputError` if it has several and does not
        support others."""
        ...

    def emitter_moments(
        self, parameters: Tree, paths: Any, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """Return the moments of y over the connections of a rendering's paths, whose request specified `emitters`.

        A connection that adds f to a sample of a pixel (S samples) has

            y = (Σ_c w_c Σ_k v_k ∂f_c/∂θ_k)² / S² + Σ_c (n_c f_c)² / S²        over the channels c,

        for tangents v, the weights w of `adjoint` and `noise` weights n, both of the shape of the images. For independent tangents of
        ±1, E[Σ y] of the first term is the second moment of a connection's contribution to `adjoint`'s gradient, summed over
        connections and elements.
        """
        ...


def drawing_emitters(session: RenderSession) -> EmitterSession:
    """Return the session if it is an `EmitterSession`. Raise `InputError` otherwise."""
    if not isinstance(session, EmitterSession):
        raise InputError("this renderer does not support custom emitter sampling; leave out emitter selection")
    return session


def counted_vertices(session: RenderSession, parameters: Tree, request: SampleRequest) -> Array:
    """Return `CountingSession.vertices` of the session. If it does not count, render an image and return ones of its shape."""
    if isinstance(session, CountingSession):
        return session.vertices(parameters, request)
    return session.image(parameters, replace(request, groups=1)).images[0] * 0.0 + 1.0


class Renderer(Protocol):
    """A scene with parameters that can be rendered and differentiated. It is immutable: rendering does not change it."""

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Return every parameter of the scene by key."""
        ...

    def values(self, keys: list[str]) -> Tree:
        """Return the scene's own values, as loaded."""
        ...

    def resolutions(self) -> list[tuple[int, int]]:
        """Return (height, width) of each sensor's film."""
        ...

    def array(self, values: np.ndarray) -> Array:
        """Return the values as an array of this renderer."""
        ...

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        """Return a session that renders the scene at other values of these parameters. Repeated calls with equal arguments are cheap.

        `space` is only validated: any session for the same parameters with derivatives may replay a rendering's paths.

        Args:
            keys: keys of the parameters that will change.
            space: sample space that two states will share; None if they will not share samples.
            derivatives: whether derivatives will be requested, or the keys that they will be requested for. `adjoint` may return arbitrary
                values for the other keys, or omit them.

        Raises `InputError` for a parameter that is unknown, not perturbable, not differentiable although its derivative is requested,
        or cannot share paths although `space` is "path".
        """
        ...


class StockLoop(Protocol):
    """One step of a standard optimisation loop, written with the functions of a renderer's own Python interface."""

    def gradient(
        self, parameters: Tree, sensor: int, spp: int, seeds: tuple[int, int], weigh: LossWeights
    ) -> tuple[Array, Tree]:
        """Return the image (H, W, 3) of a sensor, and the gradient of the loss for `weigh`'s derivatives at that image.

        Args:
            parameters, sensor: current parameters, and index of the sensor.
            spp: samples per pixel of the image, and again of the adjoint.
            seeds: seeds of the image and of the adjoint, in [0, 2**32).
            weigh: function that returns the derivative of the loss at an image.
        """
        ...


@dataclass(frozen=True, eq=False)
class ReplacedMesh:
    """New geometry of a shape.

    Attributes:
        vertices, faces: positions (V, 3), and vertex indices (F, 3).
        uv: texture coordinates (V, 2); None if the shape has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


@dataclass(frozen=True)
class Camera:
    """A sensor that can be moved.

    Attributes:
        rotation, translation: keys of its pose parameters, (3,) each: a rotation vector about its position, in radians, and a translation
            in world units.
        place: position, (3,).
    """

    rotation: str
    translation: str
    place: np.ndarray


@runtime_checkable
class WithCameras(Protocol):
    """A renderer that knows the positions of its sensors."""

    def cameras(self) -> Mapping[int, Camera]:
        """Return {sensor: camera} of the sensors that can be moved."""
        ...


@runtime_checkable
class Remeshable(Protocol):
    """A renderer whose meshes can be replaced."""

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        """Return a renderer of the same scene with the meshes {id of a shape: mesh} replaced, for the parameters `keys`."""
        ...


@runtime_checkable
class DifferentialBsdfRenderer(Protocol):
    """A renderer that can sample directions in proportion to the derivative of a BSDF."""

    def with_differential_bsdf(self) -> Renderer:
        """Return the renderer with differential BSDF sampling of roughness in `adjoint` and `tangent_moment`. Images, pairs and
        `adjoint_pair` do not change. Its `prepare` raises `InputError` if no parameter is supported. Repeated calls are cheap."""
        ...


def with_differential_bsdf(renderer: Renderer) -> Renderer:
    """Return `renderer.with_differential_bsdf()`. Raise `InputError` if the renderer does not support it."""
    if not isinstance(renderer, DifferentialBsdfRenderer):
        raise InputError("differential_bsdf: this renderer does not support differential BSDF sampling; leave it out")
    return renderer.with_differential_bsdf()


@runtime_checkable
class StockRenderer(Protocol):
    """A renderer that provides a `StockLoop`."""

    def stock(self) -> StockLoop:
        """Return the loop. Repeated calls are cheap."""
        ...
