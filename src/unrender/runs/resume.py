"""Resuming of a run from its last checkpoint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.backend.versions import deciding_versions
from unrender.core import trees
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.estimators.base import Estimator
from unrender.io import bounded_files
from unrender.methods.plan import Plan
from unrender.optimizers.base import Optimizer
from unrender.runs.budget import check_budget
from unrender.runs.callbacks import Callback
from unrender.runs.earlier_image import check_stored
from unrender.runs.folder import checkpoint, history, method_file, reader
from unrender.runs.folder.checkpoint import Checkpoint
from unrender.runs.folder.lock import holder
from unrender.runs.folder.method_file import Method
from unrender.runs.folder.schema import ENDED, HISTORY, METHOD, RunRecord
from unrender.runs.folder.state import check_alike, not_finite, unpack
from unrender.runs.folder.writer import RunWriter
from unrender.runs.loop import descend, initialize, prepare
from unrender.runs.metadata import PARTS, RunAnnotations, describe_run, fingerprint_of, first_values
from unrender.runs.number_means import NumberTrace
from unrender.runs.optimize import check, connected, open_writer
from unrender.runs.result import NON_FINITE, Result
from unrender.runs.run import SNAPSHOT_COUNTS, Run, raise_termination
from unrender.scene.coarse_to_fine import NEVER
from unrender.scene.fingerprint import differences, fingerprint, shortened
from unrender.scene.problem import Problem
from unrender.scene.serialization import origin

_OPTIONAL = ("candidate", "ahead", "numbers", "pictures", "hidden", "few_steps", "other_start")
"""Parts of a snapshot that only some runs have."""


@dataclass(frozen=True)
class StoredRun:
    """A run folder whose run can be resumed.

    Attributes:
        record: run.json.
        method: method.toml, with the new budget.
    """

    folder: Path
    record: RunRecord
    method: Method


def load_run(directory: str | Path, steps: int | None = None, seconds: float | None = None) -> StoredRun:
    """Read the description of a run from its folder, before anything that takes time.

    Args:
        steps, seconds: a budget from the run's start that replaces the run's.

    Raises:
        InputError: the folder is not a run folder, is malformed or in use, or the run is finished and the budget is not larger.
    """
    folder = Path(directory)
    record = reader.read_run_record(folder)
    if not bounded_files.exists(folder / METHOD):
        raise InputError(f"{folder / METHOD}: no such file: Result.save stores no resumable run; use run_directory=")
    method = method_file.read(folder / METHOD)
    if (process := holder(folder)) is not None:
        raise InputError(f"run folder {folder}: in use by {process}")
    budget = (method.steps, method.seconds) if steps is None and seconds is None else (steps, seconds)
    check_budget(*budget)
    done = (steps is None or steps <= record.steps) and (seconds is None or seconds <= record.seconds)
    if record.status in ENDED and done:
        so_far = f"finished, after {record.steps} steps and {record.seconds:.3g} s"
        more = max(math.ceil(2 * max(record.seconds, method.seconds or 0.0)), 1)
        raise InputError(
            f"run folder {folder}: {so_far}; to continue, give --steps {2 * max(record.steps, 1)} or --seconds {more}, counted from "
            "its start (steps= or seconds= in Python)"
        )
    return StoredRun(folder, record, method.model_copy(update={"steps": budget[0], "seconds": budget[1]}))


@exclusive("resume", long=True)
def resume_run(
    stored: StoredRun,
    problem: Problem,
    force: bool = False,
    callbacks: Sequence[Callback] = (),
    estimator: Estimator | None = None,
    optimizer: Optimizer | None = None,
    earlier: Mapping[str, float] | None = None,
    began: float | None = None,
) -> Result:
    """Resume the run. See `unrender.resume`; `earlier` contains the seconds of earlier phases; `began`: see `RunAnnotations`."""
    folder, method = stored.folder, stored.method
    run = _prepared(stored, problem, estimator, optimizer)
    run.folder, run.resumed = folder, stored.record.resumed
    run.begin_budget(began)
    run.initial, fingerprints = first_values(run), fingerprint_of(run)
    with open_writer(run, folder, method.name, method.checkpoint_every, method.final_spp) as writer:
        for source in _sources(stored):
            changes = _changes(run, stored, source.checkpoint)
            if changes and not force:
                raise InputError(
                    f"run folder {folder}: changed since: {changes}; to continue nevertheless, give --force (force=True)"
                )
            _check_budget_left(folder, method, source.checkpoint)
            if source.checkpoint is not None:
                run.ahead = _ahead(source.checkpoint)
                initialize(run, max(source.checkpoint.manifest.step - 1 + run.ahead, 0))
            restoring = _Restore(stored.record, source, changes, writer)
            run.description, run.history, run.warmup_seconds = _description(run, stored, fingerprints), [], 0.0
            try:
                with connected(run, callbacks, (restoring, writer), earlier):
                    result = descend(run)
                break
            except _UnusableCheckpoint as error:
                source.passed_over.append(str(error))  # an earlier checkpoint may be usable
        else:
            raise InputError(f"run folder {folder}: no checkpoint can be used")
    raise_termination(run)
    return result


def _prepared(stored: StoredRun, problem: Problem, estimator: Estimator | None, optimizer: Optimizer | None) -> Run:
    """Return the run before its first step. If its method does not suit a problem of other parts, an `InputError` says what changed."""
    method, table = stored.method, stored.method.model_dump()
    try:
        plan = Plan.from_table(problem, table, str(stored.folder / METHOD), estimator, optimizer)
        check(plan.estimator, plan.optimizer, method.steps, method.seconds)
        return prepare(plan, method.steps, method.seconds, method.seed)
    except InputError as error:
        fingerprints = stored.record.problem.fingerprint or {}
        before, now = {part: x for part, x in fingerprints.items() if part not in PARTS}, fingerprint(problem)
        if before.keys() == now.keys():  # the method itself is at fault, such as a type that is not installed
            raise
        raise InputError(
            f"run folder {stored.folder}: changed since: {shortened(differences(before, now))}; its method does not suit these changes; "
            "start a new run, by `unrender run`"
        ) from error


class _UnusableCheckpoint(InputError):
    """A readable checkpoint without a state that suits this run."""


def _description(run: Run, stored: StoredRun, fingerprint: dict[str, str]) -> dict[str, Any]:
    record = stored.record
    # without the settings that every run has
    settings = {k: v for k, v in record.settings.items() if k not in ("estimator", "optimizer", "steps", "seconds")}
    annotations = RunAnnotations(record.method, settings, record.choices, record.command, stored.method.final_spp)
    description = describe_run(run, annotations)
    description["problem"] |= {"fingerprint": fingerprint, "origin": origin(run.problem)}
    return description


@dataclass(frozen=True)
class _Source:
    """Point from which a run is resumed.

    Attributes:
        checkpoint: checkpoint; None for the run's start.
        records: the history, which may be longer.
        passed_over: one line for each later checkpoint that was unusable, including this one if it turns out to be.
    """

    checkpoint: Checkpoint | None
    records: list[dict[str, Any]]
    passed_over: list[str]


def _sources(stored: StoredRun) -> Iterator[_Source]:
    """Yield the readable checkpoints whose steps are in the history, latest first, or the run's start. Raises `InputError` if all are
    unusable."""
    path = stored.folder / HISTORY
    records, malformed = history.read_records(path, stored.folder) if path.exists() else ([], "")

    def reject(candidate: Checkpoint) -> str:
        if candidate.manifest.step <= history.steps_in(records):
            return ""
        reason = f"of step {candidate.manifest.step}, but {HISTORY} has only {history.steps_in(records)} steps"
        return reason + (f" ({malformed})" if malformed else "")

    for candidate, passed_over in checkpoint.candidates(stored.folder, reject):
        yield _Source(candidate, records, passed_over)


def _changes(run: Run, stored: StoredRun, source: Checkpoint | None) -> str:
    """Return the changes since the checkpoint was written (or the run started), as phrases on one line."""
    before = stored.record.problem.fingerprint if source is None else source.manifest.problem
    changed = [] if before is None else differences(before, fingerprint_of(run))
    if source is not None:
        changed += differences(source.manifest.versions, deciding_versions())
        changed += differences({"seed": str(source.manifest.seed)}, {"seed": str(stored.method.seed)})
    return shortened(changed)


def _check_budget_left(folder: Path, method: Method, source: Checkpoint | None) -> None:
    done = 0 if source is None else source.manifest.step
    if method.steps is not None and method.steps < done:
        raise InputError(
            f"run folder {folder}: {done} steps are done, expected a budget of more, got steps={method.steps}"
        )


@dataclass
class _Restore(Callback):
    """Callback that restores a warmed-up run.

    Attributes:
        record: run.json of the run so far.
        source: point from which it is resumed.
        changes: changes since then, "" for none.
    """

    record: RunRecord
    source: _Source
    changes: str
    writer: RunWriter

    def on_warm_up(self, run: Run, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        source = self.source
        try:
            saved = (
                fresh if source.checkpoint is None else _unpack(source.checkpoint, fresh, warm, run.problem.shapes())
            )
        except InputError as error:
            raise _UnusableCheckpoint(str(error)) from error
        warnings = [f"skipped: {line}" for line in source.passed_over]
        warnings += [f"resumed with force although changed since: {self.changes}"] if self.changes else []
        saved["warnings"] = [*saved["warnings"], *warnings]
        run.history[:] = (record for record in source.records if record["step"] < saved["step"])
        run.resumed = [*self.record.resumed, saved["step"]]
        run.warmup_seconds += self.record.warmup_seconds
        run.restore(saved)
        if self.record.stopped == NON_FINITE:  # resuming a stopped run means another attempt
            run.state.skipped_in_a_row = 0
        self.writer.resume(run.history, run.result())


def _unpack(
    source: Checkpoint, fresh: dict[str, Any], warm: dict[str, Any], full_shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Any]:
    """Return the snapshot of a checkpoint, after checking its types and shapes against this run's."""
    saved = unpack(source.packed, [fresh, warm])
    where = f"checkpoint of step {source.manifest.step}"
    if not isinstance(saved, dict) or [n for n in saved if n not in _OPTIONAL] != [
        n for n in fresh if n not in _OPTIONAL
    ]:
        raise InputError(f"{where}: expected the state of a run, got {repr(saved)[:60]}")
    warnings = saved["warnings"]
    if not isinstance(warnings, list) or not all(isinstance(line, str) for line in warnings):
        raise InputError(f"{where}: warnings: expected a list of lines, got {repr(warnings)[:60]}")
    for name, value in saved.items():
        if name not in ("warnings", *_OPTIONAL):
            try:
                check_alike(value, [fresh[name], warm[name]], f"{where}: {name}")
            except InputError as error:
                raise InputError(f"{error}; start the run again if another version of unrender made it") from error
    for name in SNAPSHOT_COUNTS:
        if not 0 <= saved[name] < float("inf"):
            raise InputError(f"{where}: {name}: expected a number of at least 0, got {saved[name]}")
    if saved.get("ahead", 0) != _ahead(source):
        raise InputError(f"{where}: ahead: expected a number of steps, got {saved['ahead']!r:.60}")
    if saved["step"] != source.manifest.step:
        raise InputError(f"{where}: step: expected {source.manifest.step}, got {saved['step']}")
    expected = trees.shapes(fresh["parameters"])
    if trees.shapes(saved["parameters"]) != expected:
        raise InputError(f"{where}: parameters: expected shapes {expected}, got {trees.shapes(saved['parameters'])}")
    for name in ("parameters", "optimizer"):
        if part := not_finite(saved[name], name):
            raise InputError(f"{where}: {part}: not finite")
    if "candidate" in saved:
        _check_candidate(saved["candidate"], full_shapes, f"{where}: candidate")
    if "numbers" in saved:
        NumberTrace.check(saved["numbers"], f"{where}: numbers")
    hidden = saved.get("hidden", {})
    if not isinstance(hidden, dict) or not all(key in full_shapes and type(n) is int for key, n in hidden.items()):
        raise InputError(f"{where}: hidden: expected a number of steps for meshes, got {repr(hidden)[:60]}")
    if "pictures" in saved:
        check_stored(saved["pictures"], f"{where}: pictures")
    return saved


def _ahead(source: Checkpoint) -> int:
    """Return how many steps resolutions are ahead of their schedule, before the state is restored, whose shapes depend on it."""
    match source.packed.skeleton:
        case {"dict": list(pairs)}:
            number = next((pair[1] for pair in pairs if isinstance(pair, list) and pair[:1] == ["ahead"]), 0)
            return number if type(number) is int and 0 <= number < NEVER else 0
    return 0


def _check_candidate(candidate: Any, shapes: Mapping[str, tuple[int, ...]], where: str) -> None:
    if not isinstance(candidate, dict) or candidate.keys() != {"step", "loss", "parameters"}:
        raise InputError(f"{where}: expected step, loss and parameters, got {repr(candidate)[:60]}")
    if not all(isinstance(candidate[name], (int, float)) for name in ("step", "loss")):
        raise InputError(f"{where}: expected numbers, got {candidate['step']!r:.20} and {candidate['loss']!r:.20}")
    values = candidate["parameters"]
    if not isinstance(values, dict) or not all(isinstance(x, np.ndarray) for x in values.values()):
        raise InputError(f"{where}: expected arrays, got {repr(values)[:60]}")
    if {key: x.shape for key, x in values.items()} != shapes:
        raise InputError(f"{where}: expected shapes {shapes}, got { {key: x.shape for key, x in values.items()} }")
    if part := not_finite(values, "parameters"):
        raise InputError(f"{where}: {part}: not finite")
