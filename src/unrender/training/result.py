"""What a run leaves behind."""

from __future__ import annotations

import io
import json
import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from unrender import files
from unrender.errors import InputError
from unrender.variant import current


@dataclass(frozen=True)
class Result:
    """The outcome of `optimize`.

    Attributes:
        parameters: {key: array}, float32, the recovered values.
        initial: {key: array}, where the descent began.
        history: one dictionary per step: "step" (from 0), "seconds" (of optimization so far, warm-up and callbacks left out),
            "loss", "samples" (paths traced so far), "gradient_noise" (share in [0, 1] or None), and, where the truth is known,
            "parameter_error" ({key: root mean square error}) now and then and at the last step.
        seconds: of optimization.
        warmup_seconds: of tracing and compiling kernels before the first step.
        stopped: "steps", "seconds", "interrupted", "callback" or "non-finite".
        skipped: steps whose gradient or loss was not finite, and which were not applied.
        warnings: one line each.
        info: of the last estimate, as NumPy arrays.
        name, method, settings, seed, command, problem: what was run.
        truth: {key: array} where it is known.
        pictures: {"view0/reference": (H, W, 3), ...}, linear; what reports show.
    """

    parameters: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    history: list[dict[str, Any]]
    seconds: float
    warmup_seconds: float
    stopped: str
    skipped: int = 0
    warnings: list[str] = field(default_factory=list)
    info: Mapping[str, Any] = field(default_factory=dict)
    name: str = "problem"
    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    command: str = ""
    problem: Mapping[str, Any] = field(default_factory=dict)
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """How many steps were taken, skipped ones among them."""
        return len(self.history)

    def save(self, directory: str | Path) -> Path:
        """Write the run folder: run.json, history.jsonl, parameters.npz, initial.npz, truth.npz, pictures.npz.

        Each file is written beside its place and renamed. Raises `InputError` where the folder cannot be written.
        """
        folder = Path(directory)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _write_arrays(folder / "parameters.npz", self.parameters)
            _write_arrays(folder / "initial.npz", self.initial)
            if self.truth:
                _write_arrays(folder / "truth.npz", self.truth)
            if self.pictures:
                _write_arrays(folder / "pictures.npz", self.pictures)
            lines = "".join(json.dumps(record, allow_nan=False) + "\n" for record in map(_without_nan, self.history))
            files.write(folder / "history.jsonl", lines.encode())
            files.write(folder / "run.json", (json.dumps(self._summary(), indent=2) + "\n").encode())
        except OSError as error:
            raise InputError(f"run folder {folder}: cannot be written: {error.strerror or error}") from error
        return folder

    def _summary(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "method": self.method,
            "settings": dict(self.settings),
            "seed": self.seed,
            "command": self.command,
            "versions": versions(),
            "hardware": hardware(),
            "variant": current() or "",
            "stopped": self.stopped,
            "steps": self.steps,
            "seconds": self.seconds,
            "warmup_seconds": self.warmup_seconds,
            "skipped": self.skipped,
            "warnings": list(self.warnings),
            "problem": dict(self.problem),
        }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers."""
    found = {"python": platform.python_version()}
    for package in ("unrender", "mitsuba", "drjit", "numpy"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def hardware() -> dict[str, Any]:
    """The processor and how many cores this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": _processor(), "cores": cores, "system": f"{platform.system()} {platform.machine()}"}


def _processor() -> str:
    if sys.platform == "linux":
        try:
            for line in Path("/proc/cpuinfo").read_text().splitlines():
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
        except OSError:
            pass
    return platform.processor() or platform.machine()


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **{k: np.asarray(v, np.float32) for k, v in arrays.items()})
    files.write(path, buffer.getvalue())
