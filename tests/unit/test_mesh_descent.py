"""Descents on meshes: distances of surfaces, folds, regularizers, guarded steps, two optimizers side by side."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.app.stages.stage_problem import _check
from unrender.core import tables
from unrender.core.random import Key
from unrender.estimators.base import Estimate
from unrender.gallery import meshes
from unrender.optimizers import LBFGS, Adam, Partitioned, ScheduleFree
from unrender.pixels import Views
from unrender.preconditioners import Sobolev
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.runs import loop
from unrender.runs.watches import InfluenceWatch, MeshWatch
from unrender.scene.meshes import (
    MeshRegularizer,
    Remeshing,
    _check_size,
    check_regularizer,
    check_self_intersection,
    check_surfaces,
    mesh_notices,
    remeshing_of,
)
from unrender.scene.parameter import Unknown
from unrender.scene.surfaces import Surface, crossing_triangles, folds, guarded, surface_error

POINTS, FACES = meshes.icosphere(2)
COPY, CUT, COORDINATES = meshes.unrolled(POINTS, FACES)
"""The sphere cut along its seam: of which vertex each is a copy, faces, texture coordinates."""


def test_distance_between_surfaces_is_that_of_spheres() -> None:
    fine = Surface(*meshes.icosphere(4))
    grown = Surface(1.25 * fine.vertices + [0, 0, 3.0], fine.faces)
    assert surface_error(fine, fine) < 1e-7
    # Other triangles' numbers, the same surface.
    assert surface_error(Surface(POINTS[COPY], CUT), Surface(POINTS, FACES)) < 1e-7
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
        (POINTS, FACES + 0.5, "vertex indices"),
        (POINTS, FACES + 1, "names vertex 162 of 162"),
        (POINTS, FACES[:0], "vertex indices"),
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
        check_regularizer({"edges": 1.0}, None)  # type: ignore
    with pytest.raises(ur.InputError, match="no option edge"):
        check_regularizer({"edge": 1.0}, (POINTS, FACES))  # type: ignore
    with pytest.raises(ur.InputError, match="its mesh has no edges"):
        check_regularizer({"edges": 1.0}, (POINTS, FACES[:0]))  # type: ignore


def test_no_triangle_turns_over_in_a_step() -> None:
    start = POINTS[COPY].reshape(-1).astype(np.float32)
    small = start * np.float32(0.5)
    assert guarded(start, small, CUT) is small
    # One vertex through the middle.
    inward = POINTS[COPY] * np.where(np.arange(len(POINTS)) == 40, -1.0, 1.0)[COPY][:, None]
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


def test_triangles_that_cross_are_found_as_by_solving_for_each_pair() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = rng.normal(size=(40, 3)), np.stack([rng.choice(40, 3, replace=False) for _ in range(40)])

    def crosses(one: np.ndarray, two: np.ndarray) -> bool:
        """Whether a side of `two` that has no vertex of `one` passes through `one`."""
        a, b, c = vertices[one]
        for side in two[[0, 1]], two[[1, 2]], two[[2, 0]]:
            if set(side) & set(one):
                continue
            p, q = vertices[side]
            along, u, v = np.linalg.solve(np.stack([p - q, b - a, c - a], -1), p - a)
            if 0 < along < 1 and min(u, v, 1 - u - v) > 0:
                return True
        return False

    expected = [
        (i, j)
        for i in range(40)
        for j in range(i + 1, 40)
        if len(set(faces[i]) & set(faces[j])) < 2 and (crosses(faces[i], faces[j]) or crosses(faces[j], faces[i]))
    ]
    assert len(expected) > 10
    assert crossing_triangles(vertices, faces).tolist() == [list(pair) for pair in expected]
    assert len(crossing_triangles(POINTS, FACES)) == 0
    assert len(crossing_triangles(POINTS, FACES[:1])) == 0


def test_steps_into_a_self_intersection_are_shortened_where_asked_for() -> None:
    """Two plates, one of which is to move through the other: no triangle turns over."""
    plate, two = np.array([[0, 0, 0], [1, 0, 0.1], [0, 1, 0.0]]), np.array([[0, 1, 2], [3, 4, 5]])
    start = np.concatenate([plate, plate @ [[1, 0, 0], [0, 1, 0], [0, 0, -1.0]] + [0.1, 0.1, 1.0]])
    end = start - np.where(np.arange(6) >= 3, 0.95, 0.0)[:, None] * [0, 0, 1]
    before, after = (x.reshape(-1).astype(np.float32) for x in (start, end))
    assert guarded(before, after, two) is after
    assert len(crossing_triangles(end, two)) == 1
    found = guarded(before, after, two, crossing=False)
    assert len(crossing_triangles(found.reshape(-1, 3), two)) == 0
    np.testing.assert_allclose(found, (before + after) / 2, atol=1e-6)
    onward = (end + [0, 0, 0.01]).reshape(-1).astype(np.float32)
    assert guarded(after, onward, two, crossing=False) is onward  # it passed through itself before


def test_two_optimizers_side_by_side_do_what_each_does_alone() -> None:
    rng = np.random.default_rng(2)
    start = {
        "ball.vertex_positions": rng.normal(size=12),
        "colour": rng.uniform(size=3),
        "map": rng.uniform(size=(4, 4, 1)),
    }
    start = {key: value.astype(np.float32) for key, value in start.items()}
    mesh, rest = Adam(0.01, uniform=True), ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("map",))
    both = Partitioned(("ball.vertex_positions",), mesh, rest)
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
    parts = [meshes.Ellipsoid((0, 0, 0), (0.5, 0.3, 0.4), 20.0), meshes.Ellipsoid((0.4, 0.1, 0), (0.2, 0.2, 0.2))]
    points, faces = meshes.around(meshes.united(parts, 0.02), (-1, -1, -1), (1, 1, 1), 0.08)
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(side) for side in sides} == {tuple(side) for side in sides[:, ::-1]}
    a, b, c = points[faces.T]
    volume = np.sum(a * np.cross(b, c)) / 6
    assert 4 / 3 * np.pi * 0.06 < volume < 4 / 3 * np.pi * 0.068
    depth = parts[0].depth(np.array([[0, 0, 0.4], [0, 0, 0.41], [0.0, 0, 0.38]]))
    np.testing.assert_allclose(depth, [0, -0.01, 0.02], atol=1e-3)


def test_subdivision_keeps_surface_seams_and_texture_coordinates() -> None:
    found = Remeshing((5,), "subdivide").apply(POINTS[COPY], CUT, COORDINATES)
    assert (len(found.faces), len(found.vertices)) == (4 * len(CUT), len(COPY) + len(_edges(CUT)))
    assert found.uv is not None
    np.testing.assert_array_equal(found.vertices[: len(COPY)], POINTS[COPY])
    assert surface_error(Surface(found.vertices, found.faces), Surface(POINTS, FACES)) < 1e-3
    volume = [
        np.sum(v[f[:, 0]] * np.cross(v[f[:, 1]], v[f[:, 2]]))
        for v, f in ((POINTS, FACES), (found.vertices, found.faces))
    ]
    assert volume[0] == pytest.approx(volume[1])  # and which side is out
    corners = COORDINATES[CUT].mean(axis=1)  # of the triangle in the middle of each, which comes last
    np.testing.assert_allclose(found.uv[found.faces[3 * len(CUT) :]].mean(axis=1), corners, atol=1e-12)
    _, places = np.unique(found.vertices, axis=0, return_inverse=True)
    uncut = Remeshing((5,), "subdivide").apply(POINTS, FACES, None)
    assert places.max() + 1 == len(uncut.vertices)  # the seam stays closed


def _edges(faces: np.ndarray) -> np.ndarray:
    return np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)


def test_even_triangles_on_the_same_surface() -> None:
    pytest.importorskip("gpytoolbox", reason="needs gpytoolbox: pip install 'unrender[remesh]'")
    stretched = POINTS * [1.0, 0.5, 1.7]
    found = Remeshing((5,), edge=0.6).apply(stretched[COPY], CUT, None)
    lengths = [
        np.linalg.norm(np.diff(v[_edges(f)], axis=1)[:, 0], axis=1)
        for v, f in ((stretched, FACES), (found.vertices, found.faces))
    ]
    assert lengths[1].mean() == pytest.approx(0.6 * lengths[0].mean(), rel=0.15)
    assert np.std(lengths[1]) / lengths[1].mean() < 0.6 * np.std(lengths[0]) / lengths[0].mean()
    assert surface_error(Surface(found.vertices, found.faces), Surface(stretched, FACES)) < 0.01
    open_ = Remeshing((5,)).apply(POINTS, FACES[POINTS[FACES].mean(axis=1)[:, 1] > 0], None)
    assert len(open_.faces) > 400


def test_remeshing_that_does_not_suit_is_one_line() -> None:
    fin = np.concatenate([FACES, [[FACES[0, 0], FACES[0, 1], 80]]])
    for faces, uv, message in ((fin, None, "not a manifold: 1 of"), (CUT, COORDINATES, "cannot preserve")):
        with pytest.raises(ur.InputError, match=message):
            Remeshing((5,)).check(POINTS[COPY] if uv is not None else POINTS, faces, uv)
        Remeshing((5,), "subdivide").check(POINTS, faces, uv)
    for wrong, message in (
        ((0,), "at least 1"),
        ((9, 3), "ascend"),
        ({"steps": [3], "edge": 0}, "edge must be"),
        ("3", "expected steps"),
    ):
        with pytest.raises(ur.InputError, match=message):
            remeshing_of(wrong)
    with pytest.raises(ur.InputError, match=r"would make \d+ faces"):
        Remeshing((5,), edge=1e-5).apply(POINTS, FACES, None) if _has_gpytoolbox() else _check_size(1 << 22)


def _has_gpytoolbox() -> bool:
    return importlib.util.find_spec("gpytoolbox") is not None


def test_unusual_meshes_have_a_line() -> None:
    assert mesh_notices("ball.vertex_positions", POINTS[COPY], CUT) == []
    assert mesh_notices("ball.vertex_positions", POINTS, FACES[:40]) == []  # open
    fin = np.concatenate([FACES, [[FACES[0, 0], FACES[0, 1], 80]], [[0, 0, 1], [3, 4, 3]]])
    (line,) = mesh_notices("ball.vertex_positions", POINTS, fin)
    assert line.endswith(
        "its mesh has 1 edges of more than two faces and 2 triangles without area, which are treated as borders"
    )


def of_mesh(key: str, positions: np.ndarray, faces: np.ndarray, self_intersection: Any) -> SimpleNamespace:
    """What a watch asks of a problem whose unknown is a mesh."""
    given = ur.Parameter(key, self_intersection=self_intersection)
    unknown = Unknown(given, positions.reshape(-1), (None, None), ErrorMeasure(), faces=faces)
    return SimpleNamespace(unknowns={key: unknown}, faces={key: faces})


def test_a_mesh_that_leaves_the_pictures_or_folds_has_a_line() -> None:
    key = "ball.vertex_positions"
    problem = of_mesh(key, POINTS, FACES, "ignore")
    crumpled = POINTS + 0.3 * np.random.default_rng(0).normal(size=POINTS.shape)
    run = SimpleNamespace(
        problem=problem,
        step=3,
        estimator=None,
        warnings=[],
        stopped="steps",
        parameters={key: crumpled.reshape(-1)},
        state=SimpleNamespace(hidden={}),
    )
    descent, watch = run, MeshWatch()
    for size in (0.0, 1.0, 0.0, 0.0):
        watch.on_update(descent, Estimate(0.0, {key: np.full(POINTS.size, size)}), True)  # type: ignore
    assert run.warnings == [
        f"step 3: {key}: its gradient has become zero: the mesh has left the pictures, or is hidden"
    ]
    (line,) = watch.warnings(descent)  # type: ignore
    assert "the mesh folds over at" in line
    run.parameters[key] = 2 * POINTS.reshape(-1)
    assert watch.warnings(descent) == []  # type: ignore


def test_what_to_do_with_self_intersections_is_checked() -> None:
    check_self_intersection("prevent", (POINTS, FACES))
    check_self_intersection("warn", None)
    with pytest.raises(ur.InputError, match='expected "warn", "prevent" or "ignore", got \'never\''):
        check_self_intersection("never", (POINTS, FACES))
    with pytest.raises(ur.InputError, match="this option is for the vertex positions of a mesh"):
        check_self_intersection("prevent", None)


def test_a_mesh_that_passes_through_itself_is_told_once() -> None:
    key, away = "ball.vertex_positions", np.repeat([0.0, 3.0], len(POINTS))[:, None] * [1.0, 0, 0]
    vertices, faces = np.concatenate([POINTS, POINTS]), np.concatenate([FACES, FACES + len(POINTS)])
    problem = of_mesh(key, vertices + away, faces, "ignore")
    run = SimpleNamespace(problem=problem, parameters={key: vertices + away / 2}, warnings=[], step=25, stopped="")
    run.state = SimpleNamespace(hidden={})
    watch, estimate = MeshWatch(), Estimate(0.0, {key: np.ones(vertices.size)})
    watch.on_update(run, estimate, True)  # type: ignore
    assert run.warnings == []
    run.problem = of_mesh(key, vertices + away, faces, "warn")
    for run.step in (24, 25, 50):
        watch.on_update(run, estimate, True)  # type: ignore
    (line,) = run.warnings
    assert line.startswith(f"step 25: {key}: the mesh passes through itself at ")
    run.warnings = []  # of an estimator without gradients, as of CMA-ES
    MeshWatch().on_update(run, Estimate(0.0, {}), True)  # type: ignore
    assert run.warnings == [line.replace("step 25", "step 50")]
    run.warnings, run.stopped = [line], "steps"
    assert watch.warnings(run) == []  # type: ignore


def test_whole_views_are_drawn_evenly() -> None:
    shapes = [(2, 3), (4, 4), (1, 5), (3, 3), (2, 2)]
    problem = SimpleNamespace(
        views=shapes,
        sizes=shapes,
        renderer=SimpleNamespace(array=lambda values: values),
    )
    seen = np.zeros(5)
    for step in range(400):
        sample = Views(2).redraw(problem, None, Key(0, step)).sample  # type: ignore
        assert sample is not None
        chosen, counts = np.unique(sample.views, return_counts=True)
        assert len(chosen) == 2
        for view, count in zip(chosen, counts, strict=True):
            assert count == np.prod(shapes[view])
            np.testing.assert_array_equal(np.asarray(sample.pixels)[np.asarray(sample.views) == view], np.arange(count))
        assert (np.asarray(sample.weights) == 2.5).all()  # 1 / probability
        seen[chosen] += 1
    error = np.sqrt(400 * 0.4 * 0.6)
    assert np.abs(seen - 160).max() < 4 * error
    whole = Views(9).redraw(problem, None, Key(0, 0)).sample  # type: ignore
    assert whole is not None
    assert len(np.unique(whole.views)) == 5
    assert (np.asarray(whole.weights) == 1).all()


def test_only_the_last_stage_may_remesh() -> None:
    """Before anything is rendered: the triangles that a stage ends with are not those of the next one's scene."""
    key = "ball.vertex_positions"
    first, last = (SimpleNamespace(name=name, unknowns=[key]) for name in ("coarse", "fine"))
    stages: Any = SimpleNamespace(stages=[first, last], problem="problem.toml")
    _check(stages, {key: ur.Parameter(key)})
    given = {key: ur.Parameter(key, remeshing={"steps": [5], "method": "subdivide"})}
    with pytest.raises(
        ur.InputError, match=r"stage coarse: ball.vertex_positions is remeshed, .* in the last stage alone"
    ):
        _check(stages, given)
    stages.stages = [last]
    _check(stages, given)


def test_a_warning_about_the_end_is_in_every_result_and_in_none_after_it_was_given() -> None:
    """A checkpoint of the last step asks for the warnings before the result does."""
    key, away = "ball.vertex_positions", np.repeat([0.0, 3.0], len(POINTS))[:, None] * [1.0, 0, 0]
    vertices, faces = np.concatenate([POINTS, POINTS]), np.concatenate([FACES, FACES + len(POINTS)])
    problem = of_mesh(key, vertices + away, faces, "warn")
    run: Any = SimpleNamespace(problem=problem, parameters={key: vertices + away / 2}, warnings=[], stopped="steps")
    watch = MeshWatch()
    (line,) = watch.warnings(run)
    assert watch.warnings(run) == [line]
    run.warnings = [f"step 25: {line}"]
    assert MeshWatch().warnings(run) == []  # of a resumed run


def test_a_mesh_that_passes_through_itself_is_told_beside_another_whose_name_ends_alike() -> None:
    key, away = "ball.vertex_positions", np.repeat([0.0, 3.0], len(POINTS))[:, None] * [1.0, 0, 0]
    vertices, faces = np.concatenate([POINTS, POINTS]), np.concatenate([FACES, FACES + len(POINTS)])
    problem = of_mesh(key, vertices + away, faces, "warn")
    run: Any = SimpleNamespace(problem=problem, parameters={key: vertices + away / 2}, warnings=[], stopped="steps")
    (line,) = MeshWatch().warnings(run)
    run.warnings = [f"step 25: big{line}"]
    assert MeshWatch().warnings(run) == [line]


def test_a_shortened_step_is_told_beside_that_of_a_mesh_whose_name_ends_alike() -> None:
    made = {key: SimpleNamespace(parameter=SimpleNamespace(self_intersection="warn")) for key in ("ball", "bigball")}
    run: Any = SimpleNamespace(problem=SimpleNamespace(unknowns=made), step=3, warnings=[])
    for keys in (("bigball",), ("ball",), ("ball", "bigball")):
        loop._warn_of_shortened(run, keys)
    assert [line.partition(": tri")[0] for line in run.warnings] == ["step 4: bigball", "step 4: ball"]


def test_a_mesh_that_one_view_shows_is_there_while_a_view_is_drawn_at_each_step() -> None:
    key = "ball.vertex_positions"
    problem = of_mesh(key, POINTS, FACES, "ignore")
    problem.views = [None] * 4
    run: Any = SimpleNamespace(
        problem=problem,
        parameters={key: POINTS.reshape(-1)},
        warnings=[],
        state=SimpleNamespace(zero_gradient={key: True}, hidden={}),
        estimator=ur.PathGradient(pixels=Views(1)),
        optimizer=ur.optimizers.Adam(),
    )
    mesh, influence = MeshWatch(), InfluenceWatch()
    for run.step in range(1, 161):
        shown = run.step % 10 == 9 and run.step < 100
        for watch in (mesh, influence):
            watch.on_update(run, Estimate(0.0, {key: np.full(POINTS.size, float(shown))}), True)
        assert len(run.warnings) == (run.step >= 99 + 48)
    (line,) = run.warnings
    assert line.endswith("its gradient has become zero: the mesh has left the pictures, or is hidden")
