"""Taking up a run where its last checkpoint left it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unrender.core import arrays, trees
from unrender.core.errors import InputError
from unrender.estimators.base import Estimator
from unrender.optimizers.base import Optimizer
from unrender.problem.fingerprint import differences
from unrender.problem.problem import Problem
from unrender.problem.serialization import origin
from unrender.runs.folder import checkpoint, history, method_file, record
from unrender.runs import loop
from unrender.runs.callbacks import Callback
from unrender.runs.folder.checkpoint import Checkpoint
from unrender.runs.folder.writer import HISTORY, METHOD, RunWriter
from unrender.runs.folder.lock import holder
from unrender.runs.folder.method_file import Method
from unrender.runs.folder.record import Record
from unrender.runs.result import Result, deciding_versions
from unrender.runs.run import restore
from unrender.runs.folder.state import check_alike, unpack

_MOST_SHOWN = 6
_WORDS = "warnings"


@dataclass(frozen=True)
class Stored:
    """A run folder that may be taken up.

    Attributes:
        folder: the place.
        record: run.json.
        method: method.toml, with the budget that the run is to have now.
    """

    folder: Path
    record: Record
    method: Method


def load_run(directory: str | Path, steps: int | None = None, seconds: float | None = None) -> Stored:
    """Read what a run folder says of its run, before anything that takes time.

    Args:
        directory: the run folder.
        steps, seconds: the budget from the run's start on, in place of the run's own.

    Raises:
        InputError: it is no run folder, it is malformed, in use, or finished and no larger budget is given.
    """
    folder = Path(directory)
    found = record.read(folder)
    method = method_file.read(folder / METHOD)
    if (busy := holder(folder)) is not None:
        raise InputError(f"run folder {folder}: in use by {busy}")
    budget = (method.steps, method.seconds) if steps is None and seconds is None else (steps, seconds)
    loop.check_budget(*budget)
    done = (steps is None or steps <= found.steps) and (seconds is None or seconds <= found.seconds)
    if found.status == "finished" and done:
        so_far = f"finished, after {found.steps} steps and {found.seconds:.3g} s"
        raise InputError(
            f"run folder {folder}: {so_far}; to go on, give a larger budget, in steps or seconds from its start"
        )
    return Stored(folder, found, method.model_copy(update={"steps": budget[0], "seconds": budget[1]}))


def resume_run(
    stored: Stored,
    problem: Problem,
    force: bool = False,
    callbacks: Sequence[Callback] = (),
    estimator: Estimator | None = None,
    optimizer: Optimizer | None = None,
) -> Result:
    """Take up the run. See `unrender.resume`."""
    folder, method, past = stored.folder, stored.method, stored.record
    parts = method_file.parts(method, folder / METHOD, estimator, optimizer)
    loop.check(parts.estimator, parts.optimizer, method.steps, method.seconds)
    run, memory = loop.prepare(problem, parts.estimator, parts.optimizer, method.steps, method.seconds, method.seed)
    run.folder = folder
    annotations = loop.RunAnnotations(past.method, _own_settings(past), past.command, method.final_spp)
    metadata = loop.RunMetadata(loop.describe_run(run, annotations), run.full(), method.final_spp)
    now = loop.fingerprint_of(run)
    metadata.facts["problem"] |= {"fingerprint": now, "origin": origin(problem)}
    serialize = method_file.serialize(run, method.name, method.checkpoint_every, method.final_spp)
    writer = RunWriter(folder, problem, serialize, method.checkpoint_every, lambda line: run.warnings.append(line))
    writer.take()
    try:
        records, broken = history.read(folder / HISTORY) if (folder / HISTORY).exists() else ([], "")

        def fits(found: Checkpoint) -> str:
            least = f"of step {found.manifest.step}, but {HISTORY} has only {len(records)} steps"
            return least + (f" ({broken})" if broken else "") if found.manifest.step > len(records) else ""

        found, passed = checkpoint.newest(folder, fits)
        before = past.problem.fingerprint if found is None else found.manifest.problem
        changed = [] if before is None else differences(before, now)
        if found is not None:
            changed += differences(found.manifest.versions, deciding_versions())
            changed += differences({"seed": str(found.manifest.seed)}, {"seed": str(method.seed)})
        if changed and not force:
            more = f" and {len(changed) - _MOST_SHOWN} more" if len(changed) > _MOST_SHOWN else ""
            what = "; ".join(changed[:_MOST_SHOWN]) + more
            raise InputError(f"run folder {folder}: not as it was: {what}; to go on nevertheless, force it")
        _check_room(folder, method, found)
        if found is not None:
            loop.place(run, memory, max(found.manifest.step - 1, 0))

        def take_up(fresh: dict[str, Any], warm: dict[str, Any]) -> None:
            kept = fresh if found is None else _unpacked(found, fresh, warm)
            kept[_WORDS] = [*kept[_WORDS], *(f"passed over: {line}" for line in passed)]
            kept[_WORDS] += (
                [f"resumed by force though not as it was: {'; '.join(changed[:_MOST_SHOWN])}"] if changed else []
            )
            metadata.history[:] = records[: kept["step"]]
            metadata.facts["resumed"] = [*past.resumed, kept["step"]]
            metadata.warmup += past.warmup_seconds
            restore(run, memory, kept)
            writer.resume(metadata.history, metadata.result(run))

        return loop.descend(run, memory, callbacks, metadata, writer, take_up)
    finally:
        writer.close()


def _own_settings(past: Record) -> dict[str, Any]:
    """The method's, without what is said of every run."""
    return {k: v for k, v in past.settings.items() if k not in ("estimator", "optimizer", "steps", "seconds")}


def _check_room(folder: Path, method: Method, found: Checkpoint | None) -> None:
    """Raise `InputError` where the budget ends before the checkpoint."""
    at = 0 if found is None else found.manifest.step
    if method.steps is not None and method.steps < at:
        raise InputError(
            f"run folder {folder}: {at} steps are done, expected a budget of more, got steps={method.steps}"
        )


def _unpacked(found: Checkpoint, fresh: dict[str, Any], warm: dict[str, Any]) -> dict[str, Any]:
    """The snapshot in a checkpoint, which must have the form of one of this run's."""
    kept = unpack(found.packed, [fresh, warm])
    where = f"checkpoint of step {found.manifest.step}"
    if not isinstance(kept, dict) or list(kept) != list(fresh):
        raise InputError(f"{where}: expected the state of a run, got {repr(kept)[:60]}")
    words = kept[_WORDS]
    if not isinstance(words, list) or not all(isinstance(line, str) for line in words):
        raise InputError(f"{where}: {_WORDS}: expected a list of lines, got {repr(words)[:60]}")
    for name, value in kept.items():
        if name != _WORDS:
            check_alike(value, [fresh[name], warm[name]], f"{where}: {name}")
    for name in ("step", "clock", "skipped", "samples", "in_a_row", "next_error"):
        if not 0 <= kept[name] < float("inf"):
            raise InputError(f"{where}: {name}: expected a number of at least 0, got {kept[name]}")
    if kept["step"] != found.manifest.step:
        raise InputError(f"{where}: step: expected {found.manifest.step}, got {kept['step']}")
    expected = trees.shapes(fresh["parameters"])
    if trees.shapes(kept["parameters"]) != expected:
        raise InputError(f"{where}: parameters: expected shapes {expected}, got {trees.shapes(kept['parameters'])}")
    if not all(arrays.all_finite(value) for value in kept["parameters"].values()):
        raise InputError(f"{where}: parameters: not finite")
    return kept
