"""Every optional capability of a renderer and of its sessions survives every composition of wrappers."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from tests.analytic import AnalyticRenderer
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering import picture_format
from unrender.rendering import renderer as port
from unrender.rendering.camera_poses import PosedCameras
from unrender.rendering.exposure import ExposedRenderer, VignettedRenderer
from unrender.rendering.mitsuba.pixel_format import LuminanceSession
from unrender.rendering.partial import HeldParameters, PartialDerivatives
from unrender.rendering.picture_format import PictureFormat
from unrender.rendering.renderer import Camera, EmitterMoments, SampleRequest
from unrender.rendering.response import RespondingRenderer
from unrender.rendering.tied import Tie, TiedRenderer
from unrender.rendering.worlds import World, with_worlds
from unrender.rendering.wrapper import RendererWrapper, SessionWrapper


def of_another_world(inner: Any) -> Any:
    """A fourth sensor that sees the scene with another value of a parameter."""
    scene = inner
    while isinstance(scene, RendererWrapper):
        scene = scene.inner
    return with_worlds(inner, [World(scene, 0, {"still": np.ones(1, np.float32)})])[0]


WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "partial": lambda inner: PartialDerivatives(inner, frozenset({"c0.rotation"})),
    "held": lambda inner: HeldParameters(inner, {"still": np.full((1,), 0.5)}),
    "tied": lambda inner: TiedRenderer(inner, (Tie("paint", {"map": 0.5}),)),
    "poses": lambda inner: PosedCameras(inner, [0, 1, 2]),
    "vignetting": VignettedRenderer,
    "exposure": lambda inner: ExposedRenderer(inner, [0, 1, 2]),
    "response": RespondingRenderer,
    "worlds": of_another_world,
}
OF_RENDERERS = {picture_format.WithFormats, port.WithCameras, port.Remeshable, port.DifferentialBsdfRenderer}
OF_SESSIONS = {port.CountingSession, port.EmitterSession}
NOT_FORWARDED = {port.StockRenderer, picture_format.AovRenderer}
"""A stock loop renders the scene alone, without the parameters that wrappers add or hold. Only the scene's renderer is asked for AOVs."""


class Session:
    """A session with every optional capability."""

    def __init__(self, inner: Any):
        self._inner, self.moments_of = inner, set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def vertices(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        return np.full((3, 4, 3), 7.0)

    def emitters(self) -> np.ndarray:
        return np.array([0.25, 0.75])

    def emitter_moments(self, parameters: Tree, paths: Any, tangents: Tree, weights: Any, noise: Any) -> EmitterMoments:
        assert parameters.keys() == tangents.keys()
        return EmitterMoments(np.ones(2), np.full(2, 2.0))


class Capable(AnalyticRenderer):
    """A renderer with every optional capability, three sensors, and a parameter to hold."""

    def __init__(self, notices: tuple[str, ...] = ("said",)) -> None:
        rng = np.random.default_rng(0)
        keys = [f"c{v}.{part}" for v in range(3) for part in ("rotation", "translation")]
        values = {"map": rng.uniform(0.3, 0.9, (2, 2, 1)), "still": np.zeros(1), **{key: np.zeros(3) for key in keys}}
        super().__init__(values, rng.uniform(0, 1, (36, 23)), 0.1, shape=(3, 4), sensors=3)
        self.notices = notices

    def prepare(self, keys: list[str], space: Any, derivatives: Any = True) -> Any:
        return Session(super().prepare(keys, space, derivatives))

    def formats(self) -> list[PictureFormat]:
        return [PictureFormat("luminance", signed=False)] * 3

    def cameras(self) -> Mapping[int, Camera]:
        return {v: Camera(f"c{v}.rotation", f"c{v}.translation", np.eye(3)[v]) for v in range(3)}

    def with_meshes(self, meshes: Mapping[str, Any], keys: Iterable[str]) -> Capable:
        assert set(keys) <= self.parameters().keys()
        return Capable(("remeshed",))

    def with_differential_bsdf(self) -> Capable:
        return Capable(("differential",))


def compositions() -> list[tuple[str, ...]]:
    """Each wrapper alone, and each ordered pair of them."""
    return [(name,) for name in WRAPPERS] + list(permutations(WRAPPERS, 2))


def composed(names: Iterable[str], inner: Any) -> Any:
    for name in names:
        inner = WRAPPERS[name](inner)
    return inner


def layers(renderer: Any) -> list[type]:
    found = [type(renderer)]
    while isinstance(renderer, RendererWrapper):
        renderer = renderer.inner
        found.append(type(renderer))
    return found


def lost(renderer: Any, inner: Capable) -> list[str]:
    """Names of the capabilities that a composition does not answer as the renderer inside it does."""
    keys = list(renderer.parameters())
    wrong = [kind.__name__ for kind in OF_RENDERERS if not isinstance(renderer, kind)]
    if wrong:
        return wrong
    changed = {"remeshed": renderer.with_meshes({"map": None}, keys), "differential": renderer.with_differential_bsdf()}
    wrong += [name for name, found in changed.items() if (found.notices, layers(found)) != ((name,), layers(renderer))]
    wrong += ["notices"] if tuple(renderer.notices) != inner.notices else []
    wrong += ["WithFormats"] if list(renderer.formats())[:3] != inner.formats() else []
    wrong += ["WithCameras"] if renderer.cameras().keys() != inner.cameras().keys() else []
    given = renderer.values([key for key in keys if key != "still"])
    session, request = renderer.prepare(list(given), None), SampleRequest(0, 4, 1, 2)
    wrong += [kind.__name__ for kind in OF_SESSIONS if not isinstance(session, kind)]
    if wrong:
        return wrong
    rendered = session.image(given, request)
    weights = np.ones_like(rendered.images)
    moments = session.emitter_moments(given, rendered.paths, given, weights, weights)
    wrong += [] if np.all(session.vertices(given, request) == 7.0) else ["CountingSession"]
    wrong += [] if np.array_equal(session.emitters(), [0.25, 0.75]) and moments.sums[0] == 1 else ["EmitterSession"]
    return wrong


def test_every_capability_of_the_port_is_decided_on() -> None:
    classes = [kind for module in (port, picture_format) for _, kind in inspect.getmembers(module, inspect.isclass)]
    known = {kind for kind in classes if getattr(kind, "_is_runtime_protocol", False)}
    assert known == OF_RENDERERS | OF_SESSIONS | NOT_FORWARDED


@pytest.mark.parametrize("names", compositions(), ids="+".join)
def test_capabilities_survive(names: tuple[str, ...]) -> None:
    inner = Capable()
    assert lost(composed(names, inner), inner) == []


@pytest.mark.parametrize("names", compositions(), ids="+".join)
def test_missing_capabilities_are_refused_and_not_made_up(names: tuple[str, ...]) -> None:
    class Plain(AnalyticRenderer):
        cameras = Capable.cameras

    full = Capable()
    plain = Plain(full.values(list(full.parameters())), np.ones((36, 23)), 0.1, shape=(3, 4), sensors=3)
    renderer = composed(names, plain)
    given = renderer.values([key for key in renderer.parameters() if key != "still"])
    session = renderer.prepare(list(given), None)
    assert list(renderer.formats())[:3] == [PictureFormat(signed=True)] * 3
    assert np.all(session.vertices(given, SampleRequest(0, 4, 1, 2)) == 1.0)
    with pytest.raises(InputError, match=r"keep their triangles|cannot change"):
        renderer.with_meshes({"map": None}, [])
    with pytest.raises(InputError, match="differential_bsdf"):
        renderer.with_differential_bsdf()
    with pytest.raises(InputError, match="does not support custom emitter sampling"):
        session.emitters()


def test_a_wrapper_that_drops_a_capability_is_found() -> None:
    class Forgetful(RendererWrapper):
        with_differential_bsdf = None  # pyright: ignore[reportAssignmentType]

        def formats(self) -> list[PictureFormat]:
            return [PictureFormat()] * 3

    class Dropping(RendererWrapper):
        def prepare(self, keys: list[str], space: Any, derivatives: Any = True) -> Any:
            return super().prepare(keys, space, derivatives)._inner  # pyright: ignore[reportAttributeAccessIssue]

    inner = Capable()
    assert lost(Forgetful(inner), inner) == ["DifferentialBsdfRenderer"]
    assert set(lost(Dropping(inner), inner)) == {"CountingSession", "EmitterSession"}


def test_sessions_of_luminance_forward_what_counts_and_draws() -> None:
    session = LuminanceSession(Session(None))  # pyright: ignore[reportArgumentType]
    assert isinstance(session, SessionWrapper)
    assert np.all(session.vertices({}, SampleRequest(0, 4, 1, 2)) == 7.0)
    assert session.emitters()[1] == 0.75
