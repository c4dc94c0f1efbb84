"""LargeSteps on meshes against a dense solve, one rate for all vertices, and the edges of meshes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.estimators.base import Estimate
from unrender.preconditioners import LargeSteps
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
    with pytest.raises(ur.InputError, match="expected the 15 coordinates of the mesh"):
        bound.apply(x[:2].reshape(-1))


def test_copies_of_a_vertex_move_alike() -> None:
    moved = LargeSteps(3.0).on_mesh(MeshTopology.of(POINTS, FACES)).apply(np.arange(15, dtype=np.float32))
    np.testing.assert_array_equal(moved.reshape(5, 3)[3], moved.reshape(5, 3)[4])


def test_a_constant_passes_unchanged_though_vertices_are_cut() -> None:
    """The whole mesh moves by the same, without a crease at the seam."""
    moved = LargeSteps(50.0).on_mesh(MeshTopology.of(POINTS, FACES)).apply(np.ones(15, np.float32))
    np.testing.assert_allclose(moved, 1.0, rtol=1e-5)


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
