"""Spheres deformed into SUZANNE and BANANA (HO Fig. 5), at the paper's numbers of vertices.

SUZANNE: 2562 vertices before pictures of `suzanne.ply` of Mitsuba's tutorials, which is looked for in --meshes. BANANA: 2737 vertices and
their colours, before pictures of a banana made by code, since the paper's mesh is not public. Every perturbation of vertices rebuilds the
mesh for every view, so a step is dear and there are thousands of unknowns: a short run. All but CMA-ES perturb neighbours alike, and step
so, by `LargeSteps`. σ, its schedule and the number of renders a step are chosen by hand and the same for all; each method's learning rate
or trust radius is the best of three, and of more where it is at an end, on runs of a third of the time from a seed of their own. OurHVPA
takes one product a step in the paper's form, OurJoint gradient and product from the same renders, OurG is the gradient alone. "OurJoint,
Adam" passes Newton's step through Adam, as the paper does. The error is that of the images: the loss over that at the start. Seconds are
the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, black_box, dr, mi, parts, trees, with_preconditioner
from benchmarks.races import TUNING_SEED, search
from benchmarks.runner.records import Record
from benchmarks.timed_runs import Kept

VERTICES = 2737
"""Of BANANA, as in the paper."""
_DEPTH = 2
_GREY = 0.5


def suzanne(resolution: int, views: int, vertices: int, meshes: Path) -> ur.Problem:
    """A subdivided icosahedron of at most `vertices` vertices, 2562 for the paper's. Raises `InputError` where the file is missing."""
    subdivisions = int(np.log2((vertices - 2) / 10) / 2)
    options = {"subdivisions": subdivisions, "resolution": resolution, "views": views}
    return ur.gallery.problem("sphere-to-mesh", **options, mesh=str(meshes / "suzanne.ply"))


def banana(resolution: int, views: int, vertices: int) -> ur.Problem:
    """`vertices` vertices and their colours, from a grey sphere at the body's middle."""
    directions, faces = ball(vertices)
    body, colours = bent(directions)

    def scene(points: np.ndarray, paint: np.ndarray) -> dict[str, Any]:
        return stage(resolution, views) | {"sphere": _coloured("sphere", points, faces, paint)}

    true = mi.load_dict(scene(body, colours))
    integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH})
    pictures = [
        np.array(mi.render(true, sensor=view, spp=512, seed=view, integrator=integrator)) for view in range(views)
    ]
    return ur.Problem(
        lambda: scene(0.6 * directions, np.full_like(colours, _GREY)),
        [ur.Parameter("sphere.vertex_positions"), ur.Parameter("sphere.vertex_color", bounds=(0.0, 1.0))],
        [ur.View(picture, sensor) for sensor, picture in enumerate(pictures)],
        ur.losses.L2(),
        _DEPTH,
        name="banana",
    )


def ball(vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit sphere as triangles of any number of vertices: positions (V, 3) on a spiral, and faces (2 V - 4, 3), facing outward."""
    from scipy.spatial import ConvexHull

    height = 1 - (2 * np.arange(vertices) + 1) / vertices
    angle = np.pi * (1 + 5**0.5) * np.arange(vertices)
    radius = np.sqrt(1 - height**2)
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1)
    faces = ConvexHull(points).simplices
    a, b, c = points[faces.T]
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def bent(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A thick arc from the unit sphere: positions and colours, (V, 3) each."""
    along, side, depth = directions[:, 1], directions[:, 0], directions[:, 2]
    angle = 1.1 * along
    thick = 0.34
    arc = 1.0 + thick * side
    points = np.stack([arc * np.cos(angle) - 0.8, arc * np.sin(angle), thick * depth], -1)
    end = np.clip((np.abs(along) - 0.8) / 0.15, 0, 1)[:, None]
    return points, (1 - end) * np.array([0.9, 0.75, 0.15]) + end * np.array([0.25, 0.15, 0.08])


def stage(resolution: int, views: int) -> dict[str, Any]:
    """Cameras around, by turns lower and higher, and a sky."""
    angles = 2 * np.pi * np.arange(views) / views
    return {
        "type": "scene",
        **parts.cameras_around(angles, 3.8, (0.6, 2.2), (0, 0, 0), 36.0, resolution),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}},
    }


def _coloured(name: str, points: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> Any:
    """A smooth mesh whose reflectance is its vertices' colour."""
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": paint})
    mesh = mi.Mesh(name, len(points), len(faces), properties, has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, colours.ravel().astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters["vertex_positions"] = mi.Float(points.ravel().astype(np.float32))
    parameters.update()
    return mesh


TASKS = ("SUZANNE", "BANANA")
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("BANANA",), "vertices": 60, "resolution": 8, "seconds": 0.5}

STRENGTH = 19.0
"""λ of the preconditioner, that of Nicolet, Jacobson and Jakob 2021."""
RATES = (3.0, 9.0, 27.0)
"""Of Adam, in units of σ; one for all elements where steps are smooth."""
RADII = (0.5, 1.5, 4.5)
"""Of Newton's steps: by how many σ each element moves at most, in the mean square."""


SIGMA = 0.05
SAMPLES = 64
_SPP = 1
_EXACT_SPP = 64
_POINTS = 12


def smoothed(samples: int = SAMPLES, **more: Any) -> ur.SmoothedDerivatives:
    """With the σ and the schedule of all methods."""
    schedule = ur.schedules.Exponential(60, 0.2)
    return ur.SmoothedDerivatives(SIGMA, samples, spp=_SPP, schedule=schedule, **more)


def cma_es(deviation: float) -> tuple[Any, Any]:
    """A search that begins with that deviation over 2, in units of σ."""
    optimizer = ur.optimizers.CMAES(0.5, SAMPLES, diagonal=True, learning_rate=deviation * SIGMA)
    return ur.estimators.LossValues(spp=_SPP), optimizer


def _adam(rate: float) -> ur.optimizers.Adam:
    return ur.optimizers.Adam(rate * SIGMA, uniform=True)


def _newton(radius: float, n: int, **options: Any) -> ur.optimizers.NewtonCG:
    return ur.optimizers.NewtonCG(trust_radius=radius * math.sqrt(n), iterations=1, **options)


def _through_adam(rate: float, n: int) -> ur.optimizers.NewtonCG:
    return _newton(RADII[1], n, inner_optimizer=_adam(rate))


Make = Callable[[float, int], tuple[Any, Any]]
METHODS: dict[str, tuple[Make, tuple[float, ...]]] = {
    "FR22": (lambda rate, _: (smoothed(product=True), _adam(rate)), RATES),
    "CMA-ES": (lambda deviation, _: cma_es(deviation), (0.1, 0.3, 0.9)),
    "OurG": (lambda rate, _: (smoothed(), _adam(rate)), RATES),
    "OurJoint": (lambda radius, n: (smoothed(order="hvp"), _newton(radius, n, line=True)), RADII),
    "OurJoint, Adam": (lambda rate, n: (smoothed(order="hvp"), _through_adam(rate, n)), RATES),
    "OurHVPA": (
        lambda radius, n: (smoothed(SAMPLES // 2, order="hvp", joint=False), _newton(radius, n, line=True)),
        RADII,
    ),
}
"""From a setting and the number of unknowns; and the settings that are tried."""


def problem(task: str, resolution: int, views: int, vertices: int, meshes: Path) -> ur.Problem:
    """One of `TASKS`."""
    if task == "SUZANNE":
        return suzanne(resolution, views, vertices, meshes)
    return banana(resolution, views, vertices)


def one(
    problem: ur.Problem, make: Callable[[int], tuple[Any, Any]], seconds: float, steps: int | None, seed: int
) -> dict[str, Any]:
    """One run: the images' loss at some steps."""
    kept = Kept(seconds, _POINTS, steps)
    estimator, optimizer = make(trees.ravel(problem.initial()).size)
    ur.optimize(problem, estimator, optimizer, seconds=20 * seconds, seed=seed, callbacks=[kept])
    points = [problem.initial(), *(values for _, values in kept.found)]
    evaluate = black_box(problem, problem.initial(), _EXACT_SPP, Key(99))
    losses = evaluate(np.stack([trees.ravel(point) for point in points]))
    return {
        "steps": kept.steps,
        "final": float(losses[-1] / losses[0]),
        "curve": [[0.0, *(round(at, 2) for at, _ in kept.found)], (losses / losses[0]).round(4).tolist()],
    }


def measure(
    made: ur.Problem, method: str, seconds: float, steps: int | None, runs: int, setting: float | None
) -> dict[str, Any]:
    """One method, tuned where no setting is given, over seeds 0, 1, ..."""
    make, settings = METHODS[method]
    if method != "CMA-ES":
        large = ur.preconditioners.LargeSteps(STRENGTH)
        made = with_preconditioner(made, large, *(p.key for p in made.parameters))

    def descent(setting: float, share: float, seed: int) -> dict[str, Any]:
        return one(made, lambda n: make(setting, n), share * seconds, steps and max(round(share * steps), 1), seed)

    best, tried = setting, []
    if best is None:
        best, tried = search(settings, lambda setting: descent(setting, 1 / 3, TUNING_SEED)["final"])
    found = [descent(best, 1.0, seed) for seed in range(runs)]
    print(made.name, method, best, tried, [run["final"] for run in found], flush=True)
    return {"setting": best, "tried": tried, "runs": found}


def run(
    task: tuple[str, ...] = TASKS,
    seconds: float = 60.0,
    steps: int | None = None,
    runs: int = 1,
    resolution: int = 32,
    views: int = 2,
    vertices: int = VERTICES,
    meshes: Path = Path("../shared/assets/tutorials/meshes"),
    only: tuple[str, ...] = tuple(METHODS),
    setting: float | None = None,
) -> Iterator[dict[str, Any]]:
    """A part per task and method.

    Args:
        seconds: processor time of a run
        steps: after which a run ends if its time has not; such runs have an entry of their own
        vertices: of BANANA's sphere, and the most of SUZANNE's
        meshes: folder of suzanne.ply
        setting: of all of them, which are not tuned; they have an entry of their own
    """
    dr.set_thread_count(1)
    for name in task:
        made = problem(name, resolution, views, vertices, meshes)
        numbers = trees.ravel(made.initial()).size
        for method in only:
            found = measure(made, method, seconds, steps, runs, setting)
            budget = f"{steps} steps" if steps else f"{seconds:g} s"
            entry = {"numbers": numbers, "strength": STRENGTH, "budget": budget, "methods": {method: found}}
            label = f"{name}, {budget}" if steps else name
            yield {"tasks": {f"{label}, not tuned" if setting else label: entry}}


def table(record: Record) -> str:
    """What was left of the loss."""
    rows = []
    for found in markdown.named(record["tasks"], "task", "methods", "method"):
        finals = ", ".join(f"{run['final']:.3f}" for run in found["runs"])
        steps = ", ".join(str(run["steps"]) for run in found["runs"])
        budget = found.get("budget", f"{record['settings']['seconds']:g} s")
        rows.append([markdown.fill("{task} | {numbers} | {method} | {setting:g}", found), finals, steps, budget])
    text = "{views} views of {resolution}², seconds of the processor, runs: {runs}."
    head = "task | numbers | method | rate or radius, in σ | loss / at the start | steps | budget"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    panels = {
        f"{name}: {task['numbers']} numbers": figures.run_curves(task["methods"])
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "loss / at the start", log="")
