"""A package of one file outside the tree: its estimator, loss, optimizer and method are listed, run, killed and resumed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import unrender as package
from unrender.core.errors import InputError
from unrender.methods import method as find_method
from unrender.runs.folder import checkpoint
from unrender.runs.folder.checkpoint import STATE

SOURCE = str(Path(package.__file__).parents[1])
STEPS = 300
STRANGER = '''
"""An estimator with a state, a loss, an optimizer with a state, and a method of the three."""

from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import Field, PositiveInt

import unrender as ur
from unrender.core import arrays, trees
from unrender.estimators.base import Estimate, Estimator
from unrender.methods import Options


@ur.register
@dataclass(frozen=True)
class Quartic:
    power: int = 4
    linear = False
    pixelwise = True

    def value(self, image, reference):
        return (image - reference) ** self.power

    def derivative(self, image, reference):
        return self.power * (image - reference) ** (self.power - 1)


@dataclass(frozen=True)
class Recollection:
    inner: Any
    mean: dict[str, Any]


@ur.register
@dataclass(frozen=True)
class Recalling:
    inner: Estimator = field(default_factory=ur.PathGradient)
    decay: float = 0.5

    @property
    def provides(self):
        return frozenset({"gradient"})

    def init(self, problem, parameters):
        return Recollection(self.inner.init(problem, parameters), trees.zeros_like(parameters))

    def estimate(self, problem, parameters, state, key):
        found, inner = self.inner.estimate(problem, parameters, state.inner, key)
        mean = trees.map(lambda m, g: self.decay * m + (1 - self.decay) * g, state.mean, found.gradient)
        return Estimate(found.loss, mean, info=found.info), Recollection(inner, mean)


@dataclass(frozen=True)
class Pace:
    step: int
    length: dict[str, Any]


@ur.register
@dataclass(frozen=True)
class Pacing:
    """Steps against the gradient whose lengths grow while its sign stays (Rprop)."""

    first: float = 0.001
    schedule: ur.schedules.Schedule | None = None

    @property
    def requires(self):
        return frozenset({"gradient"})

    def init(self, parameters, learning_rates=None):
        return Pace(0, {key: value * 0 + self.first for key, value in parameters.items()})

    def update(self, estimate, state, parameters):
        factor = 1.0 if self.schedule is None else self.schedule(state.step)
        steps = {key: -factor * state.length[key] * arrays.sign(g) for key, g in estimate.gradient.items()}
        return steps, Pace(state.step + 1, {key: 1.001 * length for key, length in state.length.items()})


@ur.register(name="stranger")
class StrangerMethod(Options):
    """a stranger's estimator and optimizer"""

    spp: PositiveInt = Field(4, description="samples per pixel, as a stranger asks for them")

    def build(self):
        return Recalling(ur.PathGradient(spp=self.spp)), Pacing(schedule=ur.schedules.Cosine(500))
'''  # fmt: skip
BROKEN = "raise ImportError('this library is missing\\nand more')\n"
RUN = [
    "run",
    "exponential",
    "--method",
    "stranger",
    "-p",
    "loss=Quartic",
    "--steps",
    STEPS,
    "--threads",
    1,
    "--seed",
    3,
]


def install(folder: Path, name: str, text: str) -> None:
    """One module and its metadata, as pip would leave them."""
    (folder / f"{name}.py").write_text(text)
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[unrender.components]\n{name} = {name}\n")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder of installed packages: the stranger's, and one that cannot be imported."""
    folder = tmp_path / "site"
    folder.mkdir()
    install(folder, "stranger", STRANGER)
    install(folder, "broken_stranger", BROKEN)
    return folder


def start(site: Path, *words: object) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "unrender", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": f"{SOURCE}{os.pathsep}{site}", "COLUMNS": "200"}
    return subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def answer(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, error = process.communicate(timeout=300)
    return process.returncode, out, error


def test_it_is_listed_and_a_broken_one_is_one_line(site: Path) -> None:
    status, out, error = answer(start(site, "methods", "stranger"))
    assert status == 0, error
    assert "a stranger's estimator and optimizer" in out
    assert "samples per pixel, as a stranger asks for them (a whole number above 0)" in out
    lines = error.splitlines()
    assert len(lines) == 1
    assert "broken_stranger" in lines[0]
    assert "ImportError: this library is missing and more" in lines[0]
    with pytest.raises(InputError, match="unknown method stranger; there are auto, plain, rcv"):
        find_method("stranger")  # this process does not see the package


@pytest.mark.slow
def test_it_is_killed_and_ends_as_if_undisturbed(site: Path, tmp_path: Path) -> None:
    whole, folder = tmp_path / "whole", tmp_path / "run"
    status, _, error = answer(start(site, *RUN, "--out", whole, "--checkpoint-every", 50))
    assert status == 0, error

    process = start(site, *RUN, "--out", folder, "--checkpoint-every", 2)
    history = folder / "history.jsonl"
    while process.poll() is None and not (history.exists() and history.read_bytes().count(b"\n") >= STEPS // 10):
        time.sleep(0.002)
    process.kill()
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    steps = [int(path.name) for path in (folder / checkpoint.FOLDER).glob("[0-9]*")]
    assert 0 < max(steps) < STEPS
    manifest = json.loads((folder / checkpoint.FOLDER / f"{max(steps):08d}" / "manifest.json").read_text())
    assert "stranger.Recollection" in json.dumps(manifest["state"])
    assert "stranger.Pace" in json.dumps(manifest["state"])

    how = r"; install the package that registers it \(entry-point group \"unrender\.components\"\), or import"
    with pytest.raises(InputError, match=f'"Quartic"{how}'):  # this process does not see the package
        package.resume(folder)
    with pytest.raises(InputError, match=f'method\\.toml: estimator: unknown type "Recalling".*{how}'):
        package.resume(folder, package.gallery.problem("exponential"))

    method = (folder / "method.toml").read_text()
    assert 'type = "Recalling"' in method
    assert 'type = "Pacing"' in method
    status, _, error = answer(start(site, "resume", folder))
    assert status == 0, error
    ends = [path / checkpoint.FOLDER / f"{STEPS:08d}" / STATE for path in (whole, folder)]
    assert ends[0].read_bytes() == ends[1].read_bytes()
    assert (whole / "parameters.npz").exists()


ENDLESS = '''
import hashlib, os, pathlib
from dataclasses import dataclass

import unrender as ur
from unrender.estimators.base import Estimator
from unrender.methods import Options


@ur.register
@dataclass(frozen=True)
class Endless(Estimator):
    """Prints 100 MB, and computes for ever in compiled code."""

    provides = frozenset({"gradient"})

    def init(self, problem, parameters):
        return ()

    def estimate(self, problem, parameters, state, key):
        for _ in range(10_000):
            print("x" * 10_000)
        pathlib.Path(os.environ["ENDLESS"], str(os.getpid())).touch()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)


@ur.register(name="endless")
class EndlessMethod(Options):
    """never ends"""

    spp: int = 1

    def build(self):
        return Endless(), ur.optimizers.Adam()
'''


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_trials_that_print_much_and_never_end_are_interrupted(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    """On workers by one signal; in this process by a second one, since no handler runs during compiled code."""
    install(site, "endless", ENDLESS)
    (tmp_path / "marks").mkdir()
    monkeypatch.setenv("ENDLESS", str(tmp_path / "marks"))
    monkeypatch.setenv("RAY_worker_niceness", "0")
    if workers:
        pytest.importorskip("ray")
    words = ["sweep", "exponential", "-m", "endless", "--over", "spp=1,2", "--steps", 3, "--out", tmp_path / "sweep"]
    with (tmp_path / "out").open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "unrender", *map(str, words), *(["--workers", str(workers)] if workers else [])],
            env={**os.environ, "PYTHONPATH": f"{SOURCE}{os.pathsep}{site}"},
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
        until = time.monotonic() + 200
        while len(list((tmp_path / "marks").iterdir())) < max(workers, 1):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < until
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        if not workers:
            time.sleep(1)
            process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    assert (process.returncode, error.splitlines()[-1]) == (130, "unrender: interrupted")
    assert "Traceback" not in error
    assert len(error) < 1000
    assert (workers == 0) is ((tmp_path / "out").stat().st_size > 1 << 20)
    assert json.loads((tmp_path / "sweep" / "sweep.json").read_text())["trials"] == []
