"""LargeSteps on meshes against a dense solve, one rate for all vertices, and the edges of meshes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.estimators.base import Estimate
from unrender.methods.plan import bind
from unrender.preconditioners import LargeSteps, Sobolev
from unrender.preconditioners.mesh import MeshTopology
from unrender.rendering.mitsuba.edges import edges_of

# A tetrahedron, whose last vertex is there twice, as at a seam.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 4], [2, 0, 4]])


def test_large_steps_on_a_mesh_are_a_dense_solve_on_its_places() -> None:
    laplacian = 4 * np.eye(4) - np.ones((4, 4))  # everybody is a neighbour of everybody
    copies = np.zeros((5, 4))
    copies[[0, 1, 2, 3, 4], [0, 1, 2, 3, 3]] = 1
    dense = copies @ np.linalg.inv(copies.T @ copies + 3.0 * laplacian) @ copies.T
    x = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    bound = LargeSteps(3.0).on_mesh(MeshTopology.of(POINTS, FACES))
    np.testing.assert_allclose(bound.apply(x.reshape(-1)).reshape(5, 3), dense @ x, atol=1e-6)
    assert repr(bound) == repr(LargeSteps(3.0))
    assert bound == LargeSteps(3.0)
    with pytest.raises(ur.InputError, match="LargeSteps: expected values of the mesh's 5 vertices"):
        bound.apply(x.reshape(-1)[:7])


def test_copies_of_a_vertex_move_alike() -> None:
    moved = LargeSteps(3.0).on_mesh(MeshTopology.of(POINTS, FACES)).apply(np.arange(15, dtype=np.float32))
    np.testing.assert_array_equal(moved.reshape(5, 3)[3], moved.reshape(5, 3)[4])


def test_a_constant_passes_unchanged_though_vertices_are_cut() -> None:
    """The whole mesh moves by the same, without a crease at the seam."""
    moved = LargeSteps(50.0).on_mesh(MeshTopology.of(POINTS, FACES)).apply(np.ones(15, np.float32))
    np.testing.assert_allclose(moved, 1.0, rtol=1e-5)


def sheet(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A square grid of vertices and its triangles, the first row there twice."""
    across, down = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([across, down, 0 * down], axis=-1).reshape(-1, 3).astype(np.float32)
    n = np.arange(side * side).reshape(side, side)
    upper = np.stack([n[:-1, :-1], n[1:, :-1], n[:-1, 1:]], axis=-1).reshape(-1, 3)
    lower = np.stack([n[1:, 1:], n[1:, :-1], n[:-1, 1:]], axis=-1).reshape(-1, 3)
    upper[upper < side] += side * side
    return np.concatenate([points, points[:side]]), np.concatenate([upper, lower])


@pytest.mark.parametrize("welded", [False, True])
def test_sobolev_gradients_on_a_mesh_are_near_the_dense_root_and_its_square(welded: bool) -> None:
    topology = MeshTopology.of(*sheet(12), welded)
    bound, count = Sobolev(40.0).on_mesh(topology), len(topology.places)
    assert len(topology.copies) == (144 if welded else 156)
    copies = np.zeros((count, len(topology.copies)))
    copies[np.arange(count), topology.places] = 1
    scale = np.diag(topology.copies**-0.5)
    values, vectors = np.linalg.eigh(np.eye(len(scale)) + 40.0 * scale @ topology.laplacian.toarray() @ scale)
    root = copies @ scale @ vectors @ np.diag(values**-0.5) @ vectors.T @ scale @ copies.T
    rng = np.random.default_rng(0)
    g, h = rng.normal(size=(2, count, 2)).astype(np.float32)
    h += g
    smooth = bound.apply(g.reshape(-1))
    np.testing.assert_allclose(smooth.reshape(count, 2), root @ g, atol=0.06 * np.abs(root @ g).max())
    np.testing.assert_allclose(bound.apply(np.ones(count, np.float32)), 1.0, rtol=1e-4)
    shares = np.array([1.0, 1 / 16])
    laplacian, masses = topology.laplacian.toarray(), np.diag(topology.copies.astype(float))
    for share, (product, square) in zip(shares, bound.descents(smooth, h.reshape(-1), shares).T, strict=True):
        inverse = copies @ np.linalg.inv(masses + share * 40.0 * laplacian) @ copies.T
        assert product == pytest.approx(np.sum(g * (inverse @ h)), rel=0.12)
        assert square == pytest.approx(np.sum(g * (inverse @ g)), rel=0.12)
    weaker = bound.scaled(1 / 16)
    assert np.std(weaker.apply(g.reshape(-1))) > 1.5 * np.std(smooth)
    assert weaker == Sobolev(2.5)
    np.testing.assert_allclose(
        Sobolev(0.0).on_mesh(MeshTopology.of(*sheet(12), False)).apply(g[:156, 0]), g[:156, 0], rtol=1e-6
    )


def test_schedule_free_smooths_values_at_vertices_where_the_problem_knows_their_mesh() -> None:
    """Noise in three channels of each vertex; the gradient is the same everywhere, and so becomes the step."""
    topology = MeshTopology.of(*sheet(12), welded=False)
    count = 3 * len(topology.places)
    optimizer = ur.optimizers.ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("ball.vertex_color",))
    bound = bind(optimizer, lambda key: topology, {})
    assert bound == optimizer
    rng, start = np.random.default_rng(0), {"ball.vertex_color": np.zeros(count, np.float32)}
    state, values = bound.init(start), dict(start)
    for _ in range(12):
        gradient = {"ball.vertex_color": (1.0 + 3.0 * rng.normal(size=count)).astype(np.float32)}
        steps, state = bound.update(Estimate(0.0, gradient), state, values)
        values = {key: values[key] + step for key, step in steps.items()}
    moved = values["ball.vertex_color"]
    assert moved.mean() < -0.3
    assert moved.std() < 0.25 * abs(moved.mean())
    with pytest.raises(ur.InputError, match="needs a texture"):
        optimizer.init(start)


def test_one_rate_for_all_elements() -> None:
    gradient = {"x": np.array([1.0, -0.1, 0.01], np.float32)}
    start = {"x": np.zeros(3, np.float32)}
    for uniform, expected in ((True, [-0.5, 0.05, -0.005]), (False, [-0.5, 0.5, -0.5])):
        optimizer = ur.optimizers.Adam(0.5, uniform=uniform)
        steps, _ = optimizer.update(Estimate(0.0, gradient), optimizer.init(start), start)
        np.testing.assert_allclose(steps["x"], expected, rtol=1e-4)
    with pytest.raises(ur.InputError, match="uniform must be true or false"):
        ur.optimizers.Adam(0.5, uniform=1)  # type: ignore


def mesh(points: Any, faces: Any, flat: bool = False) -> Any:
    return SimpleNamespace(
        vertex_positions_buffer=lambda: np.ravel(points),
        faces_buffer=lambda: np.ravel(faces),
        has_face_normals=lambda: flat,
        has_vertex_normals=lambda: not flat,
    )


@pytest.mark.mitsuba
def test_edges_of_closed_open_and_broken_meshes() -> None:
    closed = edges_of(mesh(POINTS, FACES), None)
    assert len(closed.ends) == 6
    assert not closed.always.any()
    assert closed.crease.sum() == 2  # where two faces meet at different copies of a vertex
    open_ = edges_of(mesh(POINTS, FACES[:3]), None)
    assert open_.always.sum() == 3
    fin = np.concatenate([FACES, [[0, 1, 5]]])
    third_face = edges_of(mesh(np.concatenate([POINTS, [[0.5, -1, -1]]]), fin), None)
    assert third_face.always.sum() == 3  # the edge of three faces, and the two at the border of the fin
    slivers = np.concatenate([FACES, [[0, 0, 1], [3, 4, 1]]])
    assert len(edges_of(mesh(POINTS, slivers), None).ends) == 6
    assert edges_of(mesh(POINTS, FACES, flat=True), None).crease.all()
    assert len(edges_of(mesh(POINTS, np.zeros((0, 3), int)), None).ends) == 0
