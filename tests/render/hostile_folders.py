"""Run folders that were damaged, by accident or on purpose: a sound one, spoilt in one way each."""

from __future__ import annotations

import functools
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hostile_inputs import Hostile, names_archive
from test_hostile_input import CHECKPOINTS, RECORDS

import unrender as ur
from unrender.app import report
from unrender.runs.folder import checkpoint

__all__ = ["FOLDERS", "HARMLESS", "warm_up"]

_MANY = 400_000


@functools.cache
def _original() -> Path:
    """A run folder with one checkpoint, stopped half-way."""
    folder = Path(tempfile.mkdtemp(prefix="hostile")) / "run"
    problem = ur.gallery.problem("exponential")
    ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(), steps=4, run_directory=folder)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "status": "interrupted"}))
    return folder


def _spoilt(spoil: Callable[[Path], Any], use: Callable[[Path], Any]) -> Hostile:
    def write(place: Path) -> Callable[[], Any]:
        folder = place / "run"
        shutil.copytree(_original(), folder)
        spoil(folder)
        return lambda: use(folder)

    return write


def _resume(folder: Path) -> Any:
    return ur.resume(folder, steps=8)


def _page(folder: Path) -> Any:
    return report.page(folder)


def _put(name: str, data: str | bytes | Callable[[], str | bytes]) -> Callable[[Path], Any]:
    """Write a file; large contents are made by a function when a test needs them."""

    def spoil(folder: Path) -> None:
        made = data() if callable(data) else data
        (folder / name).write_bytes(made.encode() if isinstance(made, str) else made)

    return spoil


def _pipe(name: str) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return spoil


def _device(name: str) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to("/dev/zero")

    return spoil


def _bomb(name: str) -> Callable[[Path], Any]:
    """Arrays of 128 MiB of zeros in as many kilobytes; the numbers of zeros that would fill a memory take long to pack."""
    return lambda folder: np.savez_compressed(folder / name, a=np.zeros(1 << 25, np.float32))


def _edited(name: str, edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        found = json.loads((folder / name).read_text())
        edit(found)
        (folder / name).write_text(json.dumps(found))

    return spoil


def _many() -> dict[str, int]:
    return {f"{number:x}": 1 for number in range(_MANY)}


def _twice() -> str:
    return "{" + "".join(f'"{number:x}": 1, ' for number in range(_MANY)) + '"0": 1}'


_STEP = f"{checkpoint.FOLDER}/00000004"
_MANIFEST, _STATE = f"{_STEP}/{checkpoint.MANIFEST}", f"{_STEP}/{checkpoint.STATE}"
_ARCHIVES = ("parameters", "initial", "truth", "pictures", "sensitivity", "standard_error", "data_share")
_KINDS = {"a pipe": _pipe, "a device": _device}

FOLDERS: dict[str, Hostile] = {
    **{f"resume: {name}": _spoilt(spoil, _resume) for name, spoil in CHECKPOINTS.items()},
    **{f"resume: {name}": _spoilt(spoil, _resume) for name, (spoil, _) in RECORDS.items()},
    **{
        f"resume: {kind} as {name.rpartition('/')[2]}": _spoilt(make(name), _resume)
        for kind, make in _KINDS.items()
        for name in ("run.json", "method.toml", "problem.toml", "history.jsonl", _MANIFEST, _STATE)
    },
    **{
        f"report: {kind} as {name}": _spoilt(make(name), _page)
        for kind, make in _KINDS.items()
        for name in ("run.json", "history.jsonl", *(f"{of}.npz" for of in _ARCHIVES))
    },
    "resume: a pipe as the controls": _spoilt(_pipe("control.json"), _resume),
    "resume: a pipe as the lock": _spoilt(_pipe("lock"), _resume),
    "report: 400000 arrays": _spoilt(_put("parameters.npz", lambda: names_archive(_MANY)), _page),
    "report: 400000 settings": _spoilt(_edited("run.json", lambda found: found.update(settings=_many())), _page),
    "report: 400000 settings, the first once more": _spoilt(_put("run.json", _twice), _page),
    "report: zeros in a thousandth of their bytes": _spoilt(_bomb("parameters.npz"), _page),
    "report: zeros in a thousandth of their bytes as pictures": _spoilt(_bomb("pictures.npz"), _page),
    "resume: 400000 names in a manifest": _spoilt(_edited(_MANIFEST, lambda found: found.update(versions=_many())), _resume),
    "resume: 400000 names in a manifest, the first once more": _spoilt(_put(_MANIFEST, _twice), _resume),
    "resume: 400000 parts of a state": _spoilt(
        _edited(_MANIFEST, lambda found: found.update(state={"list": [1] * _MANY})), _resume
    ),
    "resume: a method of 400000 lines": _spoilt(_put("method.toml", "a = [\n" + "1,\n" * _MANY + "]\n"), _resume),
    "resume: a method whose keys have 1000 parts": _spoilt(_put("method.toml", ("a." * 1000 + "b = 1\n") * 400), _resume),
    "resume: a name of 5000 characters": _spoilt(
        _put("problem.toml", f'gallery = "{"A" * 5000}"\n'), _resume
    ),
    "resume: a scene of 5000 characters": _spoilt(
        _put("problem.toml", f'scene = "{"A" * 5000}.xml"\n[[parameters]]\nkey = "a"\n[[views]]\nreference = "a"\n'), _resume
    ),
}  # fmt: skip

HARMLESS = ("resume: a pipe as the controls",)
"""These do no harm, and the run goes on."""


def warm_up(place: Path, names: Sequence[str]) -> None:
    """What is done once in a process is no folder's doing."""
    del names
    for use in (_resume, _page):
        _spoilt(lambda _: None, use)(place / use.__name__)()
