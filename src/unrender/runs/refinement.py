"""Refinement during a run: of resolutions (coarse to fine), and of meshes (remeshing); and other starts.

By default (`CoarseToFine.states`) the estimator's state is interpolated (`scene.upsampling`), and the optimizer's is not: a control
variate stays valid, whereas Adam's mean squares take a thousand steps to adapt.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.errors import InputError
from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.estimators.hybrid import HybridGradient, HybridState, beyond_paths
from unrender.methods.rules.constants import CONSTANTS
from unrender.methods.rules.places import has_scale, varied_keys
from unrender.methods.rules.starts import Place, better_place, number_of_places
from unrender.methods.rules.turns import better_turn, number_of_turns, turned_keys
from unrender.optimizers.partitioned import Partitioned
from unrender.rendering.picture_format import format_of
from unrender.rendering.renderer import Remeshable, ReplacedMesh
from unrender.runs.callbacks import Callback
from unrender.runs.folder.meshes import arrays_of
from unrender.runs.loop import begin_at, warm_up
from unrender.runs.number_means import NumberTrace
from unrender.runs.result import Result
from unrender.runs.run import GradientNoise, Run
from unrender.runs.verification import misfit_of_numbers
from unrender.scene.coarse_to_fine import NEVER
from unrender.scene.problem import Problem
from unrender.scene.upsampling import NotCarried, Upsampler, restarted, upsampled
from unrender.statistics.paired_losses import mean_and_error

if TYPE_CHECKING:
    from unrender.runs.run import Run

_MEASURED, _COARSE_SHARE = 3, 0.4
"""Number of steps that are timed to predict the number of steps in the budget, and the fraction of these after which all resolutions are
the scene's."""


def hurry(run: Run) -> None:
    """Advance the changes of resolution if the time of the first steps shows that the budget ends too early.

    It happens once, and the checkpoint stores it. Steps that the problem itself specifies are not changed.
    """
    levels = run.problem.coarse_to_fine
    if run.step != _MEASURED or not run.seconds or not levels or run.plan.problem.coarse_to_fine:
        return
    allowed = _COARSE_SHARE * run.allowed_seconds() * run.step / max(run.clock, 1e-9)
    last = max(each.steps[-1] for each in levels.values())
    run.ahead = max(0, last - max(int(allowed), run.step)) if last < NEVER else 0


def is_due(run: Run) -> bool:
    """Return whether the next step is the first with another resolution."""
    return bool(run.problem.coarse_to_fine) and trees.shapes(run.parameters) != run.problem.shapes(run.step + run.ahead)


def unfinished(run: Run) -> list[str]:
    """Return one line for each parameter that did not reach its scene's resolution, and one for a block that has not moved."""
    lines, estimator = [], run.estimator
    if isinstance(estimator, HybridGradient) and 0 < run.step <= estimator.wait:
        block = estimator.keys or beyond_paths(run.problem.renderer.parameters(), list(run.parameters))
        lines.append(
            f"{listed(list(block))}: still at the initial values after {run.step} step{'s' * (run.step != 1)}, since the first "
            f"{estimator.wait} are steps of the others; use more steps or seconds"
        )
    for key, levels in run.problem.coarse_to_fine.items():
        if (shape := arrays.shape(run.parameters[key])) != run.problem.shapes()[key] and levels.steps[-1] < NEVER:
            size = "x".join(map(str, reversed(shape[:-1])))
            lines.append(
                f"parameter {key}: still {size} at the end, after {run.step} step{'s' * (run.step != 1)} of at least {levels.steps[-1] + 1}"
            )
    return lines


def refine(run: Run) -> float:
    """Convert parameters and states to the resolution of the next step. Returns the elapsed seconds."""
    started, state = time.perf_counter(), run.state
    upsampler = Upsampler(run.problem, run.step + run.ahead, run.parameters)
    modes = {schedule.states for key, schedule in run.problem.coarse_to_fine.items() if key in upsampler.shares}
    carry = {"estimator": "reset" not in modes, "optimizer": modes == {"carry"}}
    run.parameters = upsampler.tree(run.parameters)
    fresh = (
        run.estimator.init(run.problem, run.parameters),
        run.optimizer.init(run.problem.coordinates.of(run.parameters), run.problem.learning_rates),
    )
    for name, new in zip(("estimator", "optimizer"), fresh, strict=True):
        component = getattr(state, name)
        try:
            after = upsampled(component, upsampler) if carry[name] else restarted(component, new)
        except NotCarried as error:
            run.warnings.append(f"after step {run.step}: {error} cannot be carried to another resolution: it restarts")
            after = restarted(component, new)
        setattr(state, name, after)
    state.noise = GradientNoise()
    arrays.evaluate(run.parameters, state.estimator, state.optimizer)
    return time.perf_counter() - started


class Refinement(Callback):
    """Callback that refines parameters and states at changes of resolution, and records these. Compiling counts as warm-up."""

    def __init__(self) -> None:
        self._refined = False

    def before_step(self, run: Run) -> None:
        hurry(run)
        self._refined = is_due(run)
        if self._refined:
            run.warmup_seconds += refine(run) + warm_up(run)[0]

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        keys = run.problem.coarse_to_fine
        if self._refined or (run.step == 1 and keys):
            record["resolution"] = {key: run.parameters[key].shape[:-1] for key in keys}

    def warnings(self, run: Run) -> list[str]:
        return unfinished(run) if run.stopped else []


def remeshed(problem: Problem, meshes: Mapping[str, ReplacedMesh]) -> Problem:
    """Return the problem with other meshes {key: mesh}, also as initial values. Raises `InputError` if the renderer cannot change them."""
    if not isinstance(problem.renderer, Remeshable):
        raise InputError(f"{', '.join(meshes)}: this renderer does not support remeshing")
    schedules = [
        replace(p, initial=meshes[p.key].vertices.reshape(-1).astype(np.float32)) if p.key in meshes else p
        for p in problem.parameters
    ]
    shapes = {key.rpartition(".")[0]: mesh for key, mesh in meshes.items()}
    renderer = problem.renderer.with_meshes(shapes, [p.key for p in schedules])
    # Checked views are RGB; films of other formats would misinterpret them.
    plain = all(format_of(renderer, view.sensor).colour == "rgb" for view in problem.views)
    pairs = zip(problem.original_views, problem.views, strict=True)
    made = Problem(
        renderer,
        schedules,
        [replace(own, reference=read.reference, mask=read.mask) if plain else own for own, read in pairs],
        problem.loss,
        problem.max_depth,
        truth={key: value for key, value in problem.truth.items() if key not in meshes},
        name=problem.name,
        surfaces={key: unknown.surface for key, unknown in problem.unknowns.items() if unknown.surface is not None},
    )
    return made.with_parts(
        origin=problem.origin, executor=problem.executor, remeshed_from=problem.remeshed_from or problem
    )


def _restart(run: Run, keys: Iterable[str]) -> None:
    """Restart the states after some unknowns have changed; of a `Partitioned` optimizer, only those that these keys belong to."""
    state, optimizer = run.state, run.optimizer
    fresh = optimizer.init(run.problem.coordinates.of(run.parameters), run.problem.learning_rates)
    state.estimator = restarted(state.estimator, run.estimator.init(run.problem, run.parameters))
    partitioned = isinstance(optimizer, Partitioned)
    state.optimizer = (
        optimizer.restarted(state.optimizer, fresh, keys) if partitioned else restarted(state.optimizer, fresh)
    )
    state.noise = GradientNoise()


class MeshRefinement(Callback):
    """Callback that remeshes before the steps in `Parameter.remeshing`, or warns and keeps the mesh. Compiling counts as warm-up."""

    def __init__(self) -> None:
        self._made: dict[str, int] = {}

    def before_step(self, run: Run) -> None:
        state = run.state
        remeshings = {key: unknown.remeshing for key, unknown in run.problem.unknowns.items()}
        due = {
            key: remeshing
            for key, remeshing in remeshings.items()
            if remeshing is not None and run.step in remeshing.steps
        }
        if not due:
            return
        started, meshes = time.perf_counter(), {}
        for key, remeshing in due.items():
            vertices = arrays.numpy(run.parameters[key]).reshape(-1, 3)
            try:
                mesh = remeshing.apply(vertices, run.problem.faces[key], run.problem.texture_coordinates(key))
            except InputError as error:
                run.warnings.append(f"after step {run.step}: {key}: {error}; the mesh is unchanged")
                continue
            meshes[key] = mesh
            self._made[key] = len(mesh.faces)
        if not meshes:
            return
        run.problem = remeshed(run.problem, meshes)
        unchanged = {key: arrays.numpy(value) for key, value in run.parameters.items() if key not in meshes}
        values = {key: unchanged.get(key, run.problem.unknowns[key].initial) for key in run.parameters}
        run.parameters = {key: run.problem.renderer.array(value) for key, value in values.items()}
        _restart(run, meshes)
        run.description["meshes"] = arrays_of(run.problem, run.description["meshes"])
        arrays.evaluate(run.parameters, state.estimator, state.optimizer)
        run.warmup_seconds += time.perf_counter() - started + warm_up(run)[0]

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        if self._made:
            record["faces"] = dict(self._made)
            self._made = {}


_USED, _FEWEST_STEPS = 0.4, 16  # fraction of the budget, and number of steps, after which values are compared once
_SHARE, _SHARE_OF_SCALES, _JUDGED, _MOST_SHARE, _LEAST_PATHS = 0.5, 1.0, 1 / 16, 2.5, 1 << 14
"""Paths relative to the run's so far: of all pictures, the same for scales, of one that decides, and above which a short run is not
compared; least number of paths of a picture."""
BEGUN_AGAIN = "begins again after step"
"""First words of the line about other values."""
_ERRORS = 4.0  # standard errors of the loss of scales, above which they are compared
_STILL, _CLEARLY = 0.25, 0.9
"""Share of the loss at initial values of all unknowns but poses that a descent must leave, and of the loss that a turn must have, if turns
are compared at these values."""
_NUMBER, _KEPT = 4, "kept"  # index of the set of random numbers; outcome of a comparison without a better place


class OtherStart(Callback):
    """Callback that continues a run from other values where these have a better picture.

    A descent ends in the nearest minimum. After 40 % of the budget, a new picture of few numbers is compared with the references. If they
    differ by more than noise, pictures of other values of `Plan.other_starts` are rendered. The run begins again at the best ones only if
    their loss is at most half of that of the descent so far, beyond noise. A descent that arrives is therefore not disturbed. The loss
    itself decides for positive numbers without an upper bound, such as an aperture, whose wrong pictures differ little: pictures with more
    paths compare it with 0, and with that of the best other values.

    Other turns of rotations without bounds are compared, too, and any smaller loss is enough, beyond noise; beside unknowns that are not
    few, only turns are. The other unknowns go on, see `_turned`.
    """

    def before_step(self, run: Run) -> None:
        state, keys = run.state, run.plan.other_starts
        if not keys or state.other_start or run.step < _FEWEST_STEPS or run.progress() < _USED:
            return
        rotations = turned_keys(run.problem, keys)
        alone = _few(run.problem) and not (rotations and isinstance(run.estimator, HybridGradient))
        varied = varied_keys(run.problem, keys) if alone else []
        places = 2 * number_of_turns(run.problem, rotations) + number_of_places(run.problem, varied)
        share = _SHARE_OF_SCALES if has_scale(run.problem, keys) else _SHARE
        paths = max(share / places * state.samples, _LEAST_PATHS)
        pictures = FreshPictures(run.problem, run.seed, paths, _NUMBER)
        if run.problem.executor.variant is not None or pictures.paths * places > _MOST_SHARE * state.samples:
            return
        state.other_start = _moved(run, pictures, varied) or _turned(run, pictures, rotations) or _KEPT

    def on_result(self, run: Run, result: Result) -> Result:
        line = run.state.other_start
        return replace(result, adapted=[*result.adapted, line]) if line not in ("", _KEPT) else result


def _moved(run: Run, pictures: FreshPictures, keys: Sequence[str]) -> str:
    """Begin again at other values with a much better picture. Returns a line about them, or ""."""
    problem, values = run.problem, run.full()
    if not keys:
        return ""
    scales, judged = has_scale(problem, keys), pictures
    if scales:
        judged = FreshPictures(problem, run.seed, max(_JUDGED * run.state.samples, pictures.paths), _NUMBER)
    images = judged.images(values)
    loss, error = mean_and_error(judged.losses(images))
    if not (scales and loss > _ERRORS * error) and not misfit_of_numbers(problem, judged.compare(images)):
        return ""
    known = problem.renderer.parameters()
    lights = [k for k, u in problem.unknowns.items() if known[k].brightness == "light" and u.transform is None]
    if not (place := better_place(problem, pictures, values, keys, lights, judged=judged if scales else None)):
        return ""
    before = run.state.estimator
    begin_at(run, {**run.parameters, **{k: problem.renderer.array(x) for k, x in place.values.items()}})
    if isinstance(before, HybridState):  # a block does not wait again
        run.state.estimator = replace(run.state.estimator, step=before.step)
    run.state.numbers = NumberTrace()
    return f"{BEGUN_AGAIN} {run.step} with other values of {listed(list(keys))}, {_loss(place)}"


def _turned(run: Run, pictures: FreshPictures, rotations: Sequence[str]) -> str:
    """Let poses begin again at other turns, if these have a better picture. Returns a line about them, or "".

    Textures and numbers that have adapted to a wrong turn hide the right one. So if no turn is better, and the loss is still a large share
    of that at the initial values of these, turns are compared with their initial values, and a clearly better one begins there.
    """
    problem, values, known = run.problem, run.full(), run.problem.renderer.parameters()
    place, others = better_turn(problem, pictures, values, rotations), {}
    if place is None:
        start = problem.start(run.step + run.ahead)
        others = {key: x for key, x in start.items() if not known[key].rigid}
        before = values | {key: x for key, x in problem.full(start).items() if key in others}
        now, first = (mean_and_error(pictures.losses(pictures.images(x)))[0] for x in (values, before))
        if others and now > _STILL * first:
            place = better_turn(problem, pictures, before, rotations, _CLEARLY)
    if place is None:
        return ""
    run.parameters = {**run.parameters, **others, **{k: problem.renderer.array(x) for k, x in place.values.items()}}
    arrays.evaluate(run.parameters)
    _restart(run, [*rotations, *others])
    run.state.numbers = NumberTrace()
    beside = f" and initial values of {listed(list(others))}" if others else ""
    than = "with the present turns" if others else "of the descent so far"
    return f"{BEGUN_AGAIN} {run.step} with other turns of {listed(list(place.values))}{beside}, {_loss(place, than)}"


def _few(problem: Problem) -> bool:
    return sum(unknown.initial.size for unknown in problem.unknowns.values()) <= CONSTANTS.few_numbers


def _loss(place: Place, than: str = "of the descent so far") -> str:
    return f"where the loss is {place.share:.0%} of that {than}"
