"""What a benchmark leaves: results.json, and maps.npz where it keeps images."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner.catalogue import ROOT

Record = dict[str, Any]
_DIGITS, _WIDTH = 6, 140


def command() -> str:
    """This process's command line, as it is typed in the repository."""
    return shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]])


def scratch(name: str) -> Path:
    """A folder for what a benchmark writes on the way; on the disk, not in memory, and ignored by git."""
    folder = ROOT / "out" / "benchmarks" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def provenance() -> Record:
    """Command, date, hardware and versions."""
    from benchmarks.internals import hardware, versions

    return {"command": command(), "date": time.strftime("%Y-%m-%d"), "hardware": hardware(), "versions": versions()}


def read(folder: Path) -> Record | None:
    """The record in a folder, its images under "maps"; None where there is none."""
    file = folder / "results.json"
    if not file.is_file():
        return None
    record = json.loads(file.read_text())
    if (folder / "maps.npz").is_file():
        with np.load(folder / "maps.npz", allow_pickle=False) as stored:
            record["maps"] = dict(stored)
    return record


def write(folder: Path, record: Record) -> None:
    """Write results.json, and maps.npz in single precision, each beside and renamed."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {key: value for key, value in record.items() if key != "maps"}
    part = folder / "results.json.part"
    part.write_text(_compact(_rounded(figures)) + "\n")
    os.replace(part, folder / "results.json")
    if record.get("maps"):
        images: dict[str, Any] = {name: np.float32(image) for name, image in record["maps"].items()}
        np.savez_compressed(folder / "maps.part.npz", **images)
        os.replace(folder / "maps.part.npz", folder / "maps.npz")
    print(f"wrote {folder / 'results.json'}", flush=True)


def _rounded(value: Any) -> Any:
    """Round every float of a tree to six significant digits."""
    if isinstance(value, Mapping):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _compact(value: Any, indent: int = 0) -> str:
    """Write JSON with one line for what fits into one, and for each list of numbers or of points."""
    line = json.dumps(value)
    if not isinstance(value, (dict, list)) or not value or len(line) + indent <= _WIDTH:
        return line
    pad = " " * (indent + 1)
    if isinstance(value, dict):
        parts = [f"{pad}{json.dumps(key)}: {_compact(entry, indent + 1)}" for key, entry in value.items()]
        return "{\n" + ",\n".join(parts) + "\n" + " " * indent + "}"
    if not any(
        isinstance(x, dict) or (isinstance(x, list) and any(isinstance(y, (dict, list)) for y in x)) for x in value
    ):
        return json.dumps(value, separators=(",", ":"))
    return "[\n" + ",\n".join(pad + _compact(entry, indent + 1) for entry in value) + "\n" + " " * indent + "]"


def merge(old: Mapping[str, Any], new: Mapping[str, Any], path: Sequence[str], top: bool = True) -> Record:
    """The new record, with those entries of the dictionary at `path` that only the old one has.

    Below the record itself, what stands beside the dictionary are the conditions that it was measured under: where those differ, the old
    entries are dropped.

    Args:
        path: keys down to the dictionary; "*" stands for each key.
        top: whether `old` and `new` are whole records.
    """
    if not path:
        return {**old, **new}
    head, rest = path[0], path[1:]
    if head == "*":
        return {**old, **{key: merge(old[key], new[key], rest, False) if key in old else new[key] for key in new}}
    conditions = {key for key in new if key != head} if not top else set()
    if head not in old or any(old.get(key) != plain(new[key]) for key in conditions):
        return dict(new)
    if head not in new:
        return {**new, head: old[head]}
    return {**new, head: merge(old[head], new[head], rest, False)}


def plain(value: Any) -> Any:
    """As it comes back from JSON."""
    return json.loads(json.dumps(value))
