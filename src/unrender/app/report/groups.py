"""Grouping of runs that differ only in the seed, and tests of whether runs can be compared."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unrender.app.report.html import flatten
from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.runs.folder.reader import RunFolder
from unrender.runs.folder.schema import DOUBTFUL
from unrender.scene.fingerprint import differences, shortened

_NOT_THE_METHOD = {"seed", "seconds", "steps", "out", "run_directory"}
_TOLERANCE = 0.01
_ARGUMENT = re.compile(r"(\w+)=([^=(),]+)(?=[,)])")


@dataclass(frozen=True)
class Group:
    """Runs of one method with equal settings and different seeds.

    Attributes:
        label: name of the method, with the settings that differ if several groups share the method, and with the folder's name if runs
            share the seed, too.
        runs: the runs, in the order of the arguments.
    """

    label: str
    runs: tuple[RunFolder, ...]


def group(runs: Sequence[RunFolder]) -> tuple[Group, ...]:
    """Group runs by method and settings, in order of first appearance. Seeds and budgets are not settings.

    Runs that share a seed, such as a run and its continuation, are no spread over seeds: each is a group.
    """
    kinds: dict[tuple, list[RunFolder]] = {}
    for run in runs:
        kinds.setdefault((run.record.method, tuple(_settings(run).items())), []).append(run)
    labels = [_label(kind, list(kinds)) for kind in kinds]
    unique = [
        f"{name} ({labels[: i + 1].count(name)})" if labels.count(name) > 1 else name for i, name in enumerate(labels)
    ]
    found: list[Group] = []
    for name, of in zip(unique, kinds.values(), strict=True):
        if len({run.record.seed for run in of}) == len(of):
            found.append(Group(name, tuple(of)))
        else:
            found += [Group(f"{name}, {printable(run.path.name)}", (run,)) for run in of]
    return tuple(found)


def check_comparable(runs: Sequence[RunFolder]) -> list[str]:
    """Return the weaknesses of the comparison, one line each.

    Raises `InputError` for no runs, the same run twice, a run without steps, different parameters or sizes of pictures, or references or
    true values that differ by more than 1 %.
    """
    if not runs:
        raise InputError("compare: give at least one run folder")
    first, notices = runs[0], []
    paths = [run.path.resolve() for run in runs]
    for i, run in enumerate(runs):
        if paths[i] in paths[:i]:
            raise InputError(f"{run.path}: given twice")
        if not len(run.history):
            raise InputError(f"{run.path / 'history.jsonl'}: no step was taken, there is nothing to compare")
        for key in run.parameters.keys() ^ first.parameters.keys():
            raise InputError(
                f"{run.path}: another problem than {first.path}: only one of them recovers {printable(key)}"
            )
        for view in run.views.keys() | first.views.keys():
            sizes = [of.views[view].reference.shape[:2] if view in of.views else None for of in (first, run)]
            if sizes[0] != sizes[1]:
                what = f"view {view} is {_size(sizes[1])}, not {_size(sizes[0])}"
                raise InputError(f"{run.path}: another problem than {first.path}: {what}")
        for view in run.views:
            difference = _relative_difference(run.views[view].reference, first.views[view].reference)
            if difference > _TOLERANCE:
                raise InputError(f"{run.path}: another problem than {first.path}: view {view} has another reference")
            if difference > 0:
                notices.append(
                    f"View {view} of {run.path.name} differs from that of {first.path.name} by {difference:.1g} of its values."
                )
        for key in run.truth.keys() & first.truth.keys():
            if _relative_difference(run.truth[key], first.truth[key]) > _TOLERANCE:
                raise InputError(
                    f"{run.path}: another problem than {first.path}: {printable(key)} has another true value"
                )
    records = [run.record for run in runs]
    for what, values in {
        "problems": [of.name for of in records],
        "losses, so that losses cannot be compared": [str(of.problem.description.get("loss", "")) for of in records],
        "hardware or variants, so that times cannot be compared": [f"{of.hardware} {of.variant}" for of in records],
        "versions": [str(sorted(of.versions.items())) for of in records],
    }.items():
        if len(set(values)) > 1:
            notices.append(f"These runs have different {what}.")
    notices += filter(None, (_changes(first, run) for run in runs[1:]))
    if first.record.method == "stock" and len({run.record.method for run in runs}) > 1 and _default_rate(first):
        notices.append("stock ran with its default learning rate, not tuned: ratios and times are relative to that.")
    for run in runs:
        who = f"{run.record.method}, seed {run.record.seed}"
        notices += [f"{who}: {line}" for line in run.record.warnings]
        ends = {run.record.status, run.record.stopped} & {"interrupted", "failed"}
        ends |= {run.record.status} & DOUBTFUL
        notices += [f"{who}: {end} after {run.record.seconds:.3g} s." for end in sorted(ends)]
    return list(dict.fromkeys(notices))


def _default_rate(run: RunFolder) -> bool:
    from unrender.methods import method  # imports all methods

    rate, options = "learning_rate", run.record.settings.get("options", {})
    return (
        isinstance(options, dict)
        and rate in options
        and options[rate] == method(run.record.method).options_of({})[rate]
    )


def _changes(first: RunFolder, other: RunFolder) -> str:
    """Return a line with the differences of two runs' problems, see `fingerprint.differences`; "" for none.

    Starts and settings of unknowns count only for runs of one method, because a method changes them.
    """
    records = first.record, other.record
    before, now = (record.problem.fingerprint or {} for record in records)
    ignored = ("estimator", "optimizer", *(() if records[0].method == records[1].method else ("parameter ",)))
    parts = ({part: x for part, x in of.items() if not part.startswith(ignored)} for of in (before, now))
    changes = differences(*parts) if before and now else []
    return f"{other.path.name} is of another problem than {first.path.name}: {shortened(changes)}." if changes else ""


def _relative_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square difference relative to `b`; infinity for different shapes.

    References that a gallery renders differ by rounding between machines, and in single paths between backends.
    """
    if a.shape != b.shape:
        return math.inf
    if np.array_equal(a, b, equal_nan=True):
        return 0.0
    difference = float(np.sqrt(np.mean((a - b) ** 2, dtype=np.float64) / (np.mean(b**2, dtype=np.float64) or 1e-30)))
    return difference if math.isfinite(difference) else math.inf


def _size(size: tuple[int, ...] | None) -> str:
    return "missing" if size is None else f"{size[1]} × {size[0]}"


def _settings(run: RunFolder) -> dict[str, str]:
    """Return the settings that define the method, flat; arguments within "SGD(momentum=0.9)" are separate entries."""
    settings = {}
    for name, text in sorted(flatten(run.record.settings).items()):
        if name.split(".")[-1] in _NOT_THE_METHOD:
            continue
        arguments = _ARGUMENT.findall(text)
        settings[name] = _ARGUMENT.sub(r"\1=…", text)
        for i, (argument, value) in enumerate(arguments):
            settings[f"{name}.{i}.{argument}"] = value.strip()
    return settings


def _label(kind: tuple, kinds: Sequence[tuple]) -> str:
    method, own = kind[0], dict(kind[1])
    alike = [dict(other[1]) for other in kinds if other[0] == method]
    differing = [name for name in own if any(other.get(name) != own[name] for other in alike)]
    shown = [f"{name.split('.')[-1]} {own[name]}" for name in differing if "…" not in own[name]]
    return f"{method} ({', '.join(list(dict.fromkeys(shown))[:4])})" if shown else method
