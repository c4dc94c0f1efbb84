"""Paths that are traced once: images and gradients from memory are those of the session that traces them each time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import zoo

import unrender as ur
from kernels import count_recordings
from tiers import quick, slow
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.emitters import EmitterConnection
from unrender.rendering.mitsuba.path_cache import session as caching
from unrender.rendering.mitsuba.path_cache import tracing
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.path_cache.tracing import Lookups
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest
from unrender.rendering.turns import Turns

FLOOR, BALL, LAMP = "floor.bsdf.reflectance.data", "ball.bsdf.reflectance.data", "lamp.emitter.radiance.value"


def diffuse() -> dict[str, Any]:
    """Two textures that see one another, one of them turned, wrapped by mirroring and not filtered."""
    described = zoo.scene({"type": "diffuse", "reflectance": zoo.texture(2)})
    turned = zoo.texture(3) | {"filter_type": "nearest", "wrap_mode": "mirror"}
    turned["to_uv"] = mi.ScalarTransform4f().rotate([0, 0, 1], 30).scale(2.5)
    described["floor"]["bsdf"]["reflectance"] = turned
    described["mirror"] = {"type": "sphere", "center": [1.2, -0.6, 0.5], "radius": 0.4, "bsdf": {"type": "conductor"}}
    described["glass"] = {
        "type": "sphere",
        "center": [-1.2, -0.8, 0.4],
        "radius": 0.3,
        "bsdf": {"type": "roughdielectric"},
    }
    return described


def twosided() -> dict[str, Any]:
    both = {"type": "twosided", "material": {"type": "diffuse", "reflectance": zoo.texture(2)}}
    return zoo.scene(both) | {"sensor": zoo.scene(both)["sensor"] | {"film": filtered()}}


def filtered() -> dict[str, Any]:
    return {"type": "hdrfilm", "width": zoo.SIZE, "height": zoo.SIZE, "rfilter": {"type": "mitchell"}}


def textured_lamp() -> dict[str, Any]:
    described = zoo.scene(zoo.rough(), environment=False)
    described["lamp"]["emitter"]["radiance"] = zoo.texture(4, low=0.0, high=9.0)
    described["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.4, 0.5]}}
    return described


def checkerboards() -> dict[str, Any]:
    """Textures of textures, each with a transform of its own."""
    to = mi.ScalarTransform4f
    plain: dict[str, Any] = {"type": "rgb", "value": [0.2, 0.4, 0.6]}
    inner = zoo.texture(3) | {"to_uv": to().scale(2), "wrap_mode": "clamp"}
    floor = {"type": "checkerboard", "color0": plain, "color1": inner, "to_uv": to().scale(7)}
    ball = {"type": "checkerboard", "color0": zoo.texture(2), "color1": {"type": "uniform", "value": 0.4}}
    described = zoo.scene({"type": "diffuse", "reflectance": ball})
    described["floor"]["bsdf"] = {"type": "diffuse", "reflectance": floor}
    return described


def instances() -> dict[str, Any]:
    """One material on a ball and on several instances of a group, one of whose shapes is seen from both sides."""
    to = mi.ScalarTransform4f
    described = zoo.scene({"type": "diffuse"})
    described["shared"] = {"type": "diffuse", "reflectance": zoo.texture(2)}
    described["ball"] = {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "b": {"type": "ref", "id": "shared"}}
    described["group"] = {
        "type": "shapegroup",
        "round": {"type": "sphere", "radius": 0.35, "b": {"type": "ref", "id": "shared"}},
        "flat": {
            "type": "rectangle",
            "to_world": to().translate([0, 0.5, 0]).rotate([1, 0, 0], 70).scale(0.4),
            "b": {"type": "twosided", "m": {"type": "ref", "id": "shared"}},
        },
    }
    for number, (x, y) in enumerate([(1.2, -0.6), (-1.1, -0.9)]):
        placed = to().translate([x, y, 0.4]).rotate([0, 0, 1], 20 + 120 * number).scale(1 + 0.2 * number)
        described[f"copy_{number}"] = {"type": "instance", "to_world": placed, "g": {"type": "ref", "id": "group"}}
    return described


def roulette() -> dict[str, Any]:
    """Paths that roulette ends early, by the reflectances of the current state."""
    return zoo.scene({"type": "diffuse", "reflectance": zoo.texture(2)}) | {
        "integrator": {"type": "path", "max_depth": 9, "rr_depth": 1, "hide_emitters": True}
    }


SCENES: dict[str, tuple[Callable[[], dict[str, Any]], tuple[str, ...]]] = {
    "textures": (diffuse, (FLOOR, BALL)),
    "texture and emitters": (diffuse, (BALL, LAMP, "sky.data")),
    "emitters": (textured_lamp, ("lamp.emitter.radiance.data", "sky.radiance.value")),
    "twosided, film filter": (twosided, ("ball.bsdf.brdf_0.reflectance.data", FLOOR)),
    "checkerboards": (
        checkerboards,
        ("ball.bsdf.reflectance.color0.data", "floor.bsdf.reflectance.color0.value", "sky.data"),
    ),
    "instances": (instances, ("ball.bsdf.reflectance.data", FLOOR)),
    "early roulette": (roulette, (FLOOR, BALL, LAMP)),
}


def prepared(name: str) -> tuple[CachingSession, dict[str, Any], dict[str, Any]]:
    """The session, and two states."""
    return states(*SCENES[name])


def states(
    make: Callable[[], dict[str, Any]], keys: tuple[str, ...], turns: Turns | None = None
) -> tuple[CachingSession, dict[str, Any], dict[str, Any]]:
    """See `prepared`."""
    renderer = MitsubaRenderer(make, zoo.DEPTH, turns=turns)
    session = renderer.prepare(list(keys), "path")
    assert isinstance(session, CachingSession)
    current = renderer.values(list(keys))
    previous = {key: value * 0.8 + 0.05 for key, value in current.items()}
    return session, current, previous


def requests(session: CachingSession) -> list[SampleRequest]:
    """Whole views in groups, and a mini-batch."""
    pixels = mi.UInt32(np.random.default_rng(3).integers(0, zoo.SIZE**2, 40).astype(np.uint32))
    return [SampleRequest(0, 4, 7, 2), SampleRequest(0, 3, 8, 3, pixels)]


def assert_equal(found: Any, expected: Any) -> None:
    expected = arrays.numpy(expected)
    np.testing.assert_allclose(arrays.numpy(found), expected, rtol=2e-4, atol=2e-5 * np.abs(expected).max())


def compare(session: CachingSession, current: dict[str, Any], previous: dict[str, Any]) -> None:
    """Everything, on the paths of the current state."""
    traced, rng = session._inner, np.random.default_rng(0)
    for request in requests(session):
        both = [each.image_pair(current, previous, request, "path") for each in (session, traced)]
        assert both[0].paths.vertices is not None
        assert_equal(both[0].images, both[1].images)
        assert_equal(both[0].previous, both[1].previous)
        weights = [
            mi.TensorXf(rng.normal(size=both[1].images.shape).astype(np.float32))  # pyright: ignore[reportCallIssue]
            for _ in range(2)
        ]
        gradients = [
            each.adjoint_pair(current, previous, of.paths, *weights)
            for each, of in zip((session, traced), both, strict=True)
        ]
        for found, expected in zip(*gradients, strict=True):
            for key, value in expected.items():
                assert_equal(found[key], value)
        alone = [each.image(previous, request) for each in (session, traced)]
        assert_equal(alone[0].images, alone[1].images)
        one, other = (
            each.adjoint(previous, of.paths, weights[0]) for each, of in zip((session, traced), alone, strict=True)
        )
        for key, value in other.items():
            assert_equal(one[key], value)


@pytest.mark.parametrize("name", quick(SCENES, "textures"))
def test_images_and_gradients_are_those_of_traced_paths(name: str) -> None:
    compare(*prepared(name))


def test_a_weight_that_is_three_percent_off_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    right = EmitterConnection.weight
    monkeypatch.setattr(EmitterConnection, "weight", lambda self, pdf: right(self, pdf) * 1.03)
    with pytest.raises(AssertionError, match="Not equal"):
        compare(*prepared("textures"))


def test_a_texture_that_was_black_when_paths_were_traced() -> None:
    """Paths go on where they carry nothing yet: the other state's image has all of its light."""
    session, current, previous = prepared("textures")
    black = {key: value * 0.0 for key, value in current.items()}
    request = SampleRequest(0, 64, 5)
    found = arrays.numpy(session.image_pair(black, previous, request, "path").previous)
    expected = arrays.numpy(session._inner.image(previous, request).images)
    assert abs(found.mean() / expected.mean() - 1) < 0.03


@pytest.mark.slow
def test_the_gradient_of_black_texels_has_their_indirect_light() -> None:
    """Against a difference on the same paths. Path replay leaves that light out: nothing is left to divide by the reflectance."""
    session, current, _ = prepared("textures")
    rng, request, step = np.random.default_rng(2), SampleRequest(0, 4, 7), 1e-2
    black = {key: arrays.numpy(value) * (rng.random(value.shape) < 0.5) for key, value in current.items()}
    along = {key: np.where(value == 0, rng.random(value.shape), 0.0) for key, value in black.items()}

    def rendering(length: float) -> Any:
        moved = {key: (value + length * along[key]).astype(np.float32) for key, value in black.items()}
        return session.image({key: mi.TensorXf(value) for key, value in moved.items()}, request)  # pyright: ignore[reportCallIssue, reportArgumentType]

    at, after = rendering(0), rendering(step)
    weights = rng.normal(size=at.images.shape).astype(np.float32)
    expected = ((arrays.numpy(after.images).astype(float) - arrays.numpy(at.images)) * weights).sum() / step
    values = {key: mi.TensorXf(value.astype(np.float32)) for key, value in black.items()}  # pyright: ignore[reportCallIssue, reportArgumentType]

    def slope(of: Any) -> float:
        gradient = of.adjoint(values, of.image(values, request).paths, mi.TensorXf(weights))
        return sum(float((arrays.numpy(gradient[key]) * along[key]).sum()) for key in along)

    assert slope(session) == pytest.approx(expected, rel=0.02)
    assert slope(session._inner) != pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_large_renderings_and_random_numbers_alone_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    session, current, previous = prepared("textures")
    request = SampleRequest(0, 2, 7)
    assert session.path_bytes(request) == zoo.SIZE**2 * 2 * zoo.DEPTH * 24
    assert session.image_pair(current, previous, request, "primary").paths.vertices is None
    monkeypatch.setattr(caching, "_MOST_BYTES", session.path_bytes(request) - 1)
    for rendering in (
        session.image(current, request),
        session.image_pair(current, previous, request, "path"),
    ):
        assert rendering.paths.vertices is None
        weights = mi.TensorXf(np.ones(rendering.images.shape, np.float32))  # pyright: ignore[reportCallIssue]
        assert set(session.adjoint(current, rendering.paths, weights)) == set(current)


@pytest.mark.parametrize("pairs", [False, slow(True)])
def test_paths_in_use_share_a_budget(monkeypatch: pytest.MonkeyPatch, pairs: bool) -> None:
    """A loop that renders many views before its adjoints traces those that would take more."""
    session, current, previous = prepared("textures")

    def render(request: SampleRequest) -> Any:
        return session.image_pair(current, previous, request, "path") if pairs else session.image(current, request)

    monkeypatch.setattr(caching, "_MOST_ALIVE", 2 * session.path_bytes(SampleRequest(0, 2, 7)))
    renderings = [render(SampleRequest(0, 2, seed)) for seed in range(4)]
    assert [rendering.paths.vertices is not None for rendering in renderings] == [True, True, False, False]
    weights = renderings[0].images
    assert all(set(session.adjoint(current, each.paths, weights)) == set(current) for each in renderings)
    del renderings
    assert session.image(current, SampleRequest(0, 2, 9)).paths.vertices is not None


def test_kernels_are_recorded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = count_recordings(monkeypatch)
    session, current, previous = prepared("texture and emitters")
    counts = []
    for step in range(6):
        now = {key: value * (1 - 0.01 * step) for key, value in current.items()}
        rendering = session.image_pair(now, previous, SampleRequest(0, 2, step, 2), "path")
        session.adjoint(now, rendering.paths, rendering.images)
        counts.append(len(recorded))
    assert counts[2:] == counts[2:3] * 4


NOT_SERVED = {
    "rough conductor": ("ball.bsdf.alpha.data", "RoughConductor"),
    "twosided plastic": ("ball.bsdf.brdf_0.diffuse_reflectance.data", "SmoothPlastic"),
    "mask": ("ball.bsdf.nested_bsdf.brdf_0.reflectance.data", "MaskBSDF"),
    "normal map": ("ball.bsdf.nested_bsdf.reflectance.data", "NormalMap"),
    "blend": ("ball.bsdf.bsdf_0.reflectance.data", "BlendBSDF"),
}


@pytest.mark.parametrize("material", NOT_SERVED)
def test_what_is_not_served_is_named_and_traced(material: str) -> None:
    key, named = NOT_SERVED[material]
    renderer = MitsubaRenderer(lambda: zoo.scene(zoo.MATERIALS[material][0]()), zoo.DEPTH)
    with pytest.raises(InputError, match=rf"parameter {key}.*{named}"):
        Lookups(renderer.pair, [key, FLOOR])
    assert not isinstance(renderer.prepare([key, FLOOR], None), CachingSession)
    assert isinstance(renderer.prepare([FLOOR], None), CachingSession)


def test_two_sides_of_different_materials_and_what_moves_are_not_served() -> None:
    def sides() -> dict[str, Any]:
        one, other = ({"type": "diffuse", "reflectance": zoo.texture(seed)} for seed in (2, 3))
        return zoo.scene({"type": "twosided", "front": one, "rear": other})

    renderer = MitsubaRenderer(sides, zoo.DEPTH)
    for key, named in (
        ("ball.bsdf.brdf_0.reflectance.data", "two sides"),
        ("floor.vertex_positions", "moves"),
        ("ball.translation", "pose"),
        ("floor.to_world", "the directions of paths depend on it"),
    ):
        if key in renderer.parameters():
            with pytest.raises(InputError, match=named):
                Lookups(renderer.pair, [key])


def under_sky() -> dict[str, Any]:
    """A scene under an environment map."""
    return zoo.scene({"type": "diffuse", "reflectance": zoo.texture(2)})


TURNED = Turns((0,), (("sky", ((1.5, 0.0, 0.0),)),))
"""A light of another class turns the map."""


def test_a_light_that_another_holds_is_not_served() -> None:
    """Paths meet the outer light, so the inner one would never be looked up."""
    renderer = MitsubaRenderer(under_sky, zoo.DEPTH, turns=TURNED)
    with pytest.raises(InputError, match=r"sky\.data: it is inside"):
        Lookups(renderer.pair, ["sky.data"])
    assert not isinstance(renderer.prepare(["sky.data", FLOOR], "path"), CachingSession)
    assert isinstance(renderer.prepare([FLOOR], "path"), CachingSession)


@pytest.mark.slow
def test_a_light_that_is_never_looked_up_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracing, "_check_around", lambda owner, around: None)
    with pytest.raises(AssertionError, match="Not equal"):
        compare(*states(under_sky, ("sky.data", FLOOR), TURNED))


def test_a_texture_that_a_plugin_may_hold_unseen_is_not_served() -> None:
    """Such a plugin shows `mitsuba.traverse` nothing."""

    class Silent(mi.BSDF):
        def __init__(self, properties: Any):
            super().__init__(properties)
            self.held = properties["held"]
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def traverse(self, callback: Any) -> None:
            pass

        def to_string(self) -> str:
            return "Silent[]"

    mi.register_bsdf("silent", Silent)

    def described() -> dict[str, Any]:
        shared = {"type": "ref", "id": "shared"}
        found = zoo.scene({"type": "silent", "held": shared})
        found["floor"]["bsdf"] = {"type": "diffuse", "reflectance": shared}
        return {"type": "scene", "shared": zoo.texture(2)} | found

    renderer = MitsubaRenderer(described, zoo.DEPTH)
    with pytest.raises(InputError, match="the Python plugin Silent"):
        Lookups(renderer.pair, [FLOOR])
    assert not isinstance(renderer.prepare([FLOOR], None), CachingSession)


def test_textures_beside_a_served_one_are_looked_at() -> None:
    """A checkerboard with a colour of a parameter may have its other one from elsewhere than texture coordinates."""

    def described() -> dict[str, Any]:
        other = {"type": "mesh_attribute", "name": "vertex_color"}
        board = {"type": "checkerboard", "color0": zoo.texture(2), "color1": other}
        return zoo.scene({"type": "diffuse", "reflectance": board})

    renderer = MitsubaRenderer(described, zoo.DEPTH)
    with pytest.raises(InputError, match="MeshAttribute"):
        Lookups(renderer.pair, ["ball.bsdf.reflectance.color0.data"])


@pytest.mark.slow
def test_paths_are_those_of_the_same_parameters_in_any_order() -> None:
    """Sessions of other parameters number their lookups otherwise: they trace."""
    renderer = MitsubaRenderer(SCENES["textures"][0], zoo.DEPTH)
    one, turned, more = (
        renderer.prepare(list(keys), "path") for keys in ((FLOOR, BALL), (BALL, FLOOR), (BALL, FLOOR, LAMP))
    )
    values = renderer.values([FLOOR, BALL])
    rendering = one.image(values, SampleRequest(0, 4, 7))
    expected = one.adjoint(values, rendering.paths, rendering.images)
    for other in (turned, more):
        found = other.adjoint(values, rendering.paths, rendering.images)
        for key, value in expected.items():
            assert_equal(found[key], value)


@pytest.mark.slow
def test_a_run_is_the_same_with_kept_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Step by step the same numbers, but for rounding."""
    make, keys = SCENES["textures"]
    reference = np.full((zoo.SIZE, zoo.SIZE, 3), 0.3, np.float32)

    def run() -> Any:
        renderer = MitsubaRenderer(make, 3)
        problem = ur.Problem(renderer, [ur.Parameter(key) for key in keys], [ur.View(reference)])
        estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
        return ur.optimize(problem, estimator, ur.optimizers.SGD(0.1), steps=4, seed=3)

    found = run()
    monkeypatch.setattr(MitsubaRenderer, "_caching", lambda self, session, keys, derivatives: session)
    expected = run()
    for key in keys:
        np.testing.assert_allclose(found.parameters[key], expected.parameters[key], rtol=1e-3, atol=1e-5)
