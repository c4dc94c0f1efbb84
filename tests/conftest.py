"""What the tests share: one folder of compiled kernels, a Mitsuba variant for the tests that need it, and the folder of assets.

Tests of `tests/unit` do without Mitsuba: they run in seconds. One of them that needs it says so by `@pytest.mark.mitsuba`; those of the
other folders have the mark without saying so.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from unrender.backend import variant
from unrender.core.errors import VariantError

HERE = Path(__file__).resolve().parent
KERNELS = "DRJIT_CACHE_DIR"
"""Where Dr.Jit keeps compiled kernels on disk; it reads this once, when it is imported."""

SCENES = [0]
"""Number of scenes that this process has loaded."""

# Threads of BLAS that wait for one another beside other processes take a hundred times the processor time of a small system of equations.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Where the environment forbids byte code, every test process and every command that a test starts would compile all that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Every process of the run shares one folder, the commands that tests start too. `make clean` empties it.
os.environ.setdefault(KERNELS, str(HERE.parent / ".pytest_cache" / "kernels"))
os.makedirs(os.environ[KERNELS], exist_ok=True)
# Not the user's own.
os.environ.setdefault("UNRENDER_CACHE_DIR", str(HERE.parent / ".pytest_cache" / "unrender"))
variant.prepare()  # before any test module imports Dr.Jit


@pytest.hookimpl(tryfirst=True)  # before pytest selects by mark
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE / "unit" not in item.path.parents:
            item.add_marker("mitsuba")
        if (cpu := item.get_closest_marker("cpu")) and os.environ.get("UNRENDER_VARIANT", variant.LLVM) != variant.LLVM:
            item.add_marker(pytest.mark.skip(reason=cpu.args[0]))
        if item.get_closest_marker("mitsuba") and isinstance(item, pytest.Function):
            item.fixturenames.insert(0, "mitsuba_variant")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Free the scenes of a test that refer to themselves, as `no_scene_outlives_its_file` does: else chance and speed decide which live on,
    and a second run of the tests compiles other kernels. After the teardown, since pytest holds values of fixtures until then."""
    before, start = SCENES[0], time.process_time()
    result = yield
    if SCENES[0] != before or ("mitsuba" in sys.modules and time.process_time() - start > 0.5):
        gc.collect()
    return result


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Run no test again in which its process ended, such as one over the limit of time: with `--dist loadfile`, pytest-xdist hands it to
    the next process, until `--max-worker-restart` ends the whole run."""
    from xdist.scheduler import LoadFileScheduling

    class Once(LoadFileScheduling):
        def remove_node(self, node: Any) -> str | None:
            waiting = [
                (tests, name) for tests in self.assigned_work[node].values() for name in tests if not tests[name]
            ]
            if not waiting:
                return super().remove_node(node)
            tests, ended = waiting[0]
            tests[ended] = True
            super().remove_node(node)
            return ended

        def _reschedule(self, node: Any) -> None:
            # A process runs its last test when it knows the next one, or that there is none. Files of one that ended come back without
            # the tests that are done, so that some have none left, and the others waited for ever.
            super()._reschedule(node)
            while not node.shutting_down and self._pending_of(self.assigned_work[node]) < 2:
                super()._reschedule(node)

    return Once(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_finish() -> None:
    """What was collected stays to the end: `gc.collect` need not go through it after each file."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def mitsuba_variant() -> str:
    """The variant of this test session: the CPU's, so that numbers are the same everywhere, or `UNRENDER_VARIANT`."""
    import drjit as dr

    try:
        name = variant.use(os.environ.get("UNRENDER_VARIANT", variant.LLVM))
    except VariantError as error:
        pytest.exit(str(error), returncode=3)  # once, not once per test
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        # Each worker would start a thread per core, and they would wait for each other. With one thread, reads and writes of OpenEXR
        # hang, and so do two threads of Python of which one loads a scene while the other renders.
        dr.set_thread_count(max(2, dr.thread_count() // workers))
    count_scenes()
    gc.freeze()  # Mitsuba's module, and no scene yet
    return name


def count_scenes() -> None:
    from unrender.rendering.mitsuba.description import Parsed

    instantiate = Parsed.instantiate

    def counted(self: Parsed) -> Any:
        SCENES[0] += 1
        return instantiate(self)

    Parsed.instantiate = counted


@pytest.fixture(scope="module")
def spectral_variant(mitsuba_variant: str) -> Iterator[str]:
    """The spectral variant of the same device, for all tests of a module."""
    gc.collect()
    yield variant.use(mitsuba_variant.replace("rgb", "spectral"))
    gc.collect()
    variant.use(mitsuba_variant)


@pytest.fixture
def one_thread(mitsuba_variant: str, threads_as_before: None) -> None:
    """Threads add up gradients in whatever order they come (with three or more, seen often): bits repeat with one."""
    import drjit as dr

    dr.sync_thread()
    dr.set_thread_count(1)  # `threads_as_before` sets it back


@pytest.fixture
def short_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Render final pictures with one sample, and do not test them: the end takes most of the time of a run of few steps. For tests that
    look at neither."""
    from unrender.runs.folder import writer

    render = writer.render_final_images

    def untested(problem: Any, result: Any, spp: Any, left: Any, tested: Any, *more: Any) -> Any:
        del spp, tested
        return render(problem, result, 1, left, False, *more)

    monkeypatch.setattr(writer, "render_final_images", untested)
    monkeypatch.setattr(writer, "warm_up", lambda *_: None)


@pytest.fixture(autouse=True)
def no_mitsuba_unless_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    """A test without the mark must not be the one that imports Mitsuba. Seen where tests with the mark are not collected beside it."""
    loaded = "mitsuba" in sys.modules
    yield
    if not loaded and "mitsuba" in sys.modules and not request.node.get_closest_marker("mitsuba"):
        pytest.fail("the test imported Mitsuba: mark it with @pytest.mark.mitsuba, or move it to tests/render")


@pytest.fixture(scope="session")
def assets() -> Path:
    """Assets made by others (meshes, environment maps, Mitsuba's tutorial scenes): the folder `UNRENDER_ASSETS`, else
    `shared/assets` beside the repository."""
    given = os.environ.get("UNRENDER_ASSETS")
    folder = Path(given) if given else HERE.parents[1] / "shared" / "assets"
    if not folder.is_dir():
        pytest.skip(f"no assets: {folder} is not a folder; set UNRENDER_ASSETS to one")
    return folder


@pytest.fixture(autouse=True, scope="module")
def no_scene_outlives_its_file() -> Iterator[None]:
    """A kernel that calls materials or media is compiled for all that live in the process, those of other files' scenes too: with six
    more of them, tests of media take three times as long."""
    yield
    gc.collect()
    if "mitsuba" not in sys.modules:  # a frozen scene would live on, and later derivatives of other scenes would fail
        gc.freeze()


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    """Commands and dealt runs set how many threads Dr.Jit has. With one, a later test that writes OpenEXR would wait for ever."""
    before = sys.modules["drjit"].thread_count() if "drjit" in sys.modules else None
    yield
    if before is not None:
        dr = sys.modules["drjit"]
        if dr.thread_count() != before:
            dr.sync_thread()
            dr.set_thread_count(before)
