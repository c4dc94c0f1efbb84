"""A run's call chain is short, and few objects hold its problem."""

from __future__ import annotations

import gc
import traceback
from pathlib import Path
from typing import Any

import pytest

import unrender
from tiers import slow
from unrender.app.cli.main import main
from unrender.rendering.mitsuba import frozen
from unrender.rendering.mitsuba.integrators.path import PathPair
from unrender.rendering.mitsuba.integrators.volpath import VolumePair
from unrender.rendering.mitsuba.path_cache.tracing import TracePass
from unrender.scene.problem import Problem

pytestmark = pytest.mark.mitsuba

MOST_FRAMES, MOST_HOLDERS = 15, 4
SOURCE = str(Path(unrender.__file__).parent)
POSTER = ["poster", "-p", "resolution=8", "-p", "texture_resolution=8", "-p", "reference_spp=16"]
SMOKE = ["smoke", "-p", "resolution=8", "-p", "grid_resolution=8", "-p", "views=2", "-p", "reference_spp=16"]


class Recorder:
    """Notes our frames, and what holds a problem, at each bounce of a step or its warm-up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.chains: set[tuple[str, ...]] = set()
        self.holders: set[str] = set()
        for kernel in (PathPair, VolumePair, TracePass):
            monkeypatch.setattr(kernel, "_bounce", self.recording(kernel._bounce))

    def recording(self, bounce: Any) -> Any:
        def recorded(kernel: Any, *arguments: Any) -> Any:
            stack = [frame for frame in traceback.extract_stack()[:-1] if frame.filename.startswith(SOURCE)]
            chain = tuple(f"{frame.filename.removeprefix(SOURCE)}:{frame.name}" for frame in stack)
            if any(name.endswith(":estimate") for name in chain):
                self.chains.add((*chain, "_bounce"))
                self.holders = self.holders or holders()
            return bounce(kernel, *arguments)

        return recorded

    def faults(self) -> str:
        """What exceeds the limits, "" for nothing."""
        longest = max(self.chains, key=len, default=())
        too_long = "" if len(longest) <= MOST_FRAMES else f"{len(longest)} frames: {' > '.join(longest)}. "
        return too_long + (f"held by {sorted(self.holders)}" if len(self.holders) > MOST_HOLDERS else "")


def holders() -> set[str]:
    """Kinds of our objects with an attribute that is a problem."""
    found = set()
    for each in gc.get_objects():
        # `isinstance` reads attributes of the object, and one of PyTorch's warns then that it is deprecated.
        kind = type(each)
        if issubclass(kind, type) or not str(getattr(kind, "__module__", "")).startswith("unrender."):
            continue
        for name, value in getattr(each, "__dict__", {}).items():
            if isinstance(value, Problem):
                found.add(f"{kind.__name__}.{name}")
    return found


def run(folder: Path, *words: str) -> None:
    assert main(["run", *words, "--steps", "2", "--final-spp", "1", "--out", str(folder), "--no-cache"]) in (0, 5)


@pytest.mark.parametrize(
    "words", [POSTER, slow([*POSTER, "-m", "plain"]), slow(SMOKE)], ids=["poster", "plain", "smoke"]
)
def test_few_frames_lead_from_the_command_to_a_bounce(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(monkeypatch)
    run(tmp_path / "run", *words)
    assert any(name.endswith(":warm_up") for chain in recorder.chains for name in chain)
    assert not recorder.faults()


@pytest.mark.slow
def test_few_frames_lead_to_a_bounce_that_is_traced_at_each_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frozen, "_recorder", lambda function, tracing: None)
    recorder = Recorder(monkeypatch)
    run(tmp_path / "run", *POSTER)
    assert any(name.endswith(":_step") for chain in recorder.chains for name in chain)
    assert not recorder.faults()


@pytest.mark.slow
def test_a_call_that_only_forwards_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A method of one line around each launch, twice, as if it stood in our source."""
    text = "def forwarding(inner):\n    def call(*given):\n        return inner(*given)\n    return call\n"
    space: dict[str, Any] = {}
    exec(compile(text, f"{SOURCE}/planted.py", "exec"), space)
    forwarding = space["forwarding"]
    monkeypatch.setattr(frozen.FrozenFunction, "__call__", forwarding(forwarding(frozen.FrozenFunction.__call__)))
    recorder = Recorder(monkeypatch)
    run(tmp_path / "run", *POSTER)
    assert "planted.py:call > " in recorder.faults()
