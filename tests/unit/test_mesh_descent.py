"""Descents on meshes: distances of surfaces, folds, regularizers, guarded steps, two optimizers side by side."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import unrender as ur
from unrender.core import tables
from unrender.estimators.base import Estimate
from unrender.evaluation.surfaces import Surface, folds, surface_error
from unrender.gallery import blobs, meshes
from unrender.optimizers import LBFGS, Adam, Partitioned, ScheduleFree
from unrender.preconditioners import LargeSteps, Sobolev
from unrender.problem.mesh_checks import check_regularizer, check_surfaces
from unrender.problem.mesh_regularizer import MeshRegularizer
from unrender.runs.mesh_guard import guarded

POINTS, FACES = meshes.icosphere(2)
COPY, CUT, COORDINATES = meshes.unrolled(POINTS, FACES)
"""The sphere cut along its seam: of which vertex each is a copy, faces, texture coordinates."""


def test_distance_between_surfaces_is_that_of_spheres() -> None:
    fine = Surface(*meshes.icosphere(4))
    grown = Surface(1.25 * fine.vertices + [0, 0, 3.0], fine.faces)
    assert surface_error(fine, fine) < 1e-7
    assert (
        surface_error(Surface(POINTS[COPY], CUT), Surface(POINTS, FACES)) < 1e-7
    )  # other triangles' numbers, the same surface
    assert surface_error(fine, Surface(1.25 * fine.vertices, fine.faces)) == pytest.approx(0.25, rel=0.02)
    assert surface_error(fine, grown) == pytest.approx(surface_error(grown, fine))
    square = Surface(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]]), np.array([[0, 1, 2], [1, 3, 2]]))
    lifted = Surface(square.vertices + [0, 0, 0.3], square.faces)
    np.testing.assert_allclose(square.distances_from(lifted), 0.3)  # exact, whatever the samples are


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (POINTS[:, :2], FACES, r"finite vertices of shape \(V, 3\)"),
        (np.where(POINTS > 0.9, np.nan, POINTS), FACES, "finite vertices"),
        (POINTS, FACES + 0.5, "whole numbers"),
        (POINTS, FACES + 1, "names vertex 162 of 162"),
        (POINTS, FACES[:0], "whole numbers"),
        (np.zeros((162, 3)), FACES, "none of its faces has an area"),
    ],
)
def test_what_is_no_surface_is_one_line(vertices: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(ur.InputError, match=message):
        Surface(vertices, faces)
    with pytest.raises(ur.InputError, match="no vertex positions among the parameters"):
        check_surfaces({"ball.vertex_position": Surface(POINTS, FACES)}, {"ball.vertex_positions": FACES})


def test_folds_are_counted() -> None:
    assert folds(POINTS, FACES) == 0
    hinge = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0.9, 0.1, 0.01]])
    faces = np.array([[0, 2, 1], [0, 1, 3]])
    assert folds(hinge, faces) == 1
    assert folds(hinge * [[1, 1, 1], [1, 1, 1], [1, 1, 1], [-1, 1, 1]], faces) == 0
    assert folds(hinge, np.array([[0, 2, 1], [0, 0, 1]])) == 0  # without area


@pytest.mark.parametrize("terms", [{"bilaplacian": 0.3}, {"edges": 0.7}, {"bilaplacian": 0.2, "edges": 0.1}])
def test_regularizers_have_the_gradient_of_their_value(terms: dict[str, float]) -> None:
    rng = np.random.default_rng(1)
    x, along = (rng.normal(size=(len(POINTS), 3))[COPY] for _ in range(2))
    x = (POINTS[COPY] + 0.05 * x).reshape(-1)
    bound = MeshRegularizer(**terms).on_mesh(POINTS[COPY], CUT)
    value, gradient = bound.evaluate(x)
    ends = [bound.evaluate(x + side * 1e-5 * along.reshape(-1))[0] for side in (1, -1)]
    assert value > 0
    assert gradient @ along.reshape(-1) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)
    uncut = MeshRegularizer(**terms).on_mesh(POINTS, FACES)  # the seam does not show
    moved = np.zeros((len(POINTS), 3))
    moved[COPY] = x.reshape(-1, 3)
    assert uncut.evaluate(moved.reshape(-1))[0] == pytest.approx(value)
    # The whole mesh shifted has the same, the second term at any size.
    assert bound.evaluate(x + 3.0)[0] == pytest.approx(value)
    if not bound.bilaplacian:
        assert bound.evaluate(2 * x)[0] == pytest.approx(value)


def test_a_regularizer_needs_a_mesh() -> None:
    with pytest.raises(ur.InputError, match="vertex positions of a mesh"):
        check_regularizer({"edges": 1.0}, SimpleNamespace(mesh=None))  # type: ignore
    with pytest.raises(ur.InputError, match="no option edge"):
        check_regularizer({"edge": 1.0}, SimpleNamespace(mesh=lambda: (POINTS, FACES)))  # type: ignore
    with pytest.raises(ur.InputError, match="its mesh has no edges"):
        check_regularizer({"edges": 1.0}, SimpleNamespace(mesh=lambda: (POINTS, FACES[:0])))  # type: ignore


def test_no_triangle_turns_over_in_a_step() -> None:
    start = POINTS[COPY].reshape(-1).astype(np.float32)
    small = start * np.float32(0.5)
    assert guarded(start, small, CUT) is small
    inward = (
        POINTS[COPY] * np.where(np.arange(len(POINTS)) == 40, -1.0, 1.0)[COPY][:, None]
    )  # one vertex through the middle
    torn = POINTS[COPY] + np.random.default_rng(0).normal(size=POINTS.shape)[COPY]
    for wanted in (inward, torn, -POINTS[COPY]):
        found = guarded(start, wanted.reshape(-1).astype(np.float32), CUT).reshape(-1, 3)
        a, b = (
            np.cross(*np.moveaxis(np.diff(v.astype(float)[CUT], axis=1), 1, 0)) for v in (start.reshape(-1, 3), found)
        )
        assert (np.sum(a * b, axis=1) > 0).all()
        joined = np.zeros_like(POINTS)
        joined[COPY] = found
        np.testing.assert_array_equal(joined[COPY], found.astype(float))  # seams stay closed
    assert np.abs(found - start.reshape(-1, 3)).max() >= 0


def test_two_optimizers_side_by_side_do_what_each_does_alone() -> None:
    rng = np.random.default_rng(2)
    start = {
        "ball.vertex_positions": rng.normal(size=12),
        "colour": rng.uniform(size=3),
        "map": rng.uniform(size=(4, 4, 1)),
    }
    start = {key: value.astype(np.float32) for key, value in start.items()}
    mesh, rest = Adam(0.01, uniform=True), ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("map",))
    both = Partitioned(("ball.vertex_positions",), mesh, rest, LargeSteps(19.0))
    assert both.preconditioners == {"ball.vertex_positions": LargeSteps(19.0)}
    own, others = {"ball.vertex_positions": start["ball.vertex_positions"]}, {k: start[k] for k in ("colour", "map")}
    states = both.init(start, {"colour": 0.3}), mesh.init(own), rest.init(others, {"colour": 0.3})
    for _ in range(3):
        gradient = {key: rng.normal(size=value.shape).astype(np.float32) for key, value in start.items()}
        steps, one = both.update(Estimate(0.0, gradient), states[0], start)
        alone, two = mesh.update(Estimate(0.0, {k: gradient[k] for k in own}), states[1], own)
        beside, three = rest.update(Estimate(0.0, {k: gradient[k] for k in others}), states[2], others)
        states = one, two, three
        assert list(steps) == list(start)
        for key, step in (alone | beside).items():
            np.testing.assert_array_equal(steps[key], step)
    assert both.choices(states[0]) == rest.choices(states[2])
    assert tables.component(tables.table(both)) == both  # a run folder stores it
    with pytest.raises(ur.InputError, match='unknown parameter "ball"'):
        Partitioned(("ball",), mesh, rest).init(start)
    with pytest.raises(ur.InputError, match="requires the gradient alone"):
        Partitioned((), LBFGS(), ur.optimizers.Newton())


def test_blobs_are_closed_and_face_outward() -> None:
    parts = [blobs.Ellipsoid((0, 0, 0), (0.5, 0.3, 0.4), 20.0), blobs.Ellipsoid((0.4, 0.1, 0), (0.2, 0.2, 0.2))]
    points, faces = blobs.around(blobs.united(parts, 0.02), (-1, -1, -1), (1, 1, 1), 0.08)
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(side) for side in sides} == {tuple(side) for side in sides[:, ::-1]}
    a, b, c = points[faces.T]
    volume = np.sum(a * np.cross(b, c)) / 6
    assert 4 / 3 * np.pi * 0.06 < volume < 4 / 3 * np.pi * 0.068
    depth = parts[0].depth(np.array([[0, 0, 0.4], [0, 0, 0.41], [0.0, 0, 0.38]]))
    np.testing.assert_allclose(depth, [0, -0.01, 0.02], atol=1e-3)
