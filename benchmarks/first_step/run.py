"""From typing `unrender run PROBLEM` to its first step, with a warm cache and with an empty one.

Each problem of the gallery is run twice for one step in processes of their own: first with an empty cache folder, where the kernels are
compiled and the reference images rendered, then with the folder that the first run left. The clock runs from the start of the process to
the line of the first step; what goes before it is told by the run's own phases.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import unrender as ur

GALLERY = tuple(ur.gallery.names())
PHASES = ("loading", "reference images", "compiling")
QUICK = {"problem": ("mirror-trio",), "options": ("resolution=16", "reference_spp=1")}


def start(name: str, options: tuple[str, ...], cache: Path, out: Path) -> dict[str, Any]:
    """Seconds to the first line that names a step, and of the phases before it."""
    words = [part for option in options for part in ("--problem-set", option)]
    command = [
        sys.executable,
        "-m",
        "unrender",
        "run",
        name,
        "--steps",
        "1",
        "--final-spp",
        "1",
        "--out",
        str(out),
        *words,
    ]
    kept = {name: value for name, value in os.environ.items() if name != "DRJIT_CACHE_DIR"}  # of this process
    environment = {**kept, "UNRENDER_CACHE_DIR": str(cache)}
    began, first = time.perf_counter(), None
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if first is None and line.startswith("step "):
                first = time.perf_counter() - began
    if first is None or process.returncode:
        raise ur.InputError(f"{name}: no first step")
    spent = json.loads((out / "run.json").read_text())["phases"]
    return {"seconds": first, **{phase: spent.get(phase, 0.0) for phase in PHASES}}


def run(problem: tuple[str, ...] = GALLERY, options: tuple[str, ...] = ()) -> Iterator[dict[str, Any]]:
    """Every problem.

    Args:
        problem: of the gallery
        options: of the problems, such as "resolution=32"
    """
    found: dict[str, Any] = {"problems": {}}
    for name in problem:
        with tempfile.TemporaryDirectory() as folder:
            cache = Path(folder) / "cache"
            entry = {kind: start(name, options, cache, Path(folder) / kind) for kind in ("cold", "warm")}
        found["problems"][name] = entry
        print(f"{name}: cold {entry['cold']['seconds']:.1f} s, warm {entry['warm']['seconds']:.1f} s", flush=True)
        yield found
