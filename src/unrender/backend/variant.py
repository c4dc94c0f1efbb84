"""Which Mitsuba variant runs: a GPU where one really works, else the CPU with an LLVM that is safe.

The only caller of `mitsuba.set_variant`. Nothing in `unrender` reaches a kernel before `ensure()` or `use()` has
answered.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import functools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unrender.backend import cache, install_hints, limits, llvm, plugins
from unrender.core.errors import InputError, VariantError
from unrender.core.suggestions import did_you_mean
from unrender.core.text import reason_of

CUDA = "cuda_ad_rgb"
LLVM = "llvm_ad_rgb"
VARIANTS = (CUDA, LLVM)
"""Three colour channels, with derivatives, unpolarised: what every formula here is written for."""

_INITIALISATION = 0.5
"""Seconds that Dr.Jit takes at most to find that a library will not do."""

_THREADS = 4
"""Threads for each core at most."""

_kept = False
_setting = threading.RLock()
"""Mitsuba's names are half there while another thread sets its variant."""

_GPU_TRIAL = """
import os, sys
sys.path[:] = {path!r}
import drjit as dr, mitsuba as mi
mi.file_resolver().prepend(os.path.dirname(mi.__file__))  # see plugins.py
mi.set_variant({variant!r})
scene = mi.load_dict({{"type": "scene", "wall": {{"type": "rectangle"}}}})
rays = mi.Ray3f(mi.Point3f(dr.linspace(mi.Float, -0.5, 0.5, 8), 0, 2), mi.Vector3f(0, 0, -1))
assert dr.allclose(scene.ray_intersect_preliminary(rays).t, 2)
"""


def prepare() -> None:
    """Choose the LLVM library that Dr.Jit will load. Call it before the first `import drjit` of the process.

    Dr.Jit reads `DRJIT_LIBLLVM_PATH` once, when it is imported, and without it takes the first library it finds, even
    one that aborts later. So the variable is set here, to the newest one known to work. One that the user has set is
    left alone (and judged by `use`). Likewise `DRJIT_CACHE_DIR`, the folder
    of compiled kernels. Nothing is loaded, no kernel runs. Does nothing once Dr.Jit is imported.

    Raises:
        VariantError: a system library without which Dr.Jit cannot be imported at all is missing.
    """
    if "drjit" in sys.modules:
        return
    if missing := llvm.missing_companions():
        install = install_hints.command(missing)
        raise VariantError(f"{' and '.join(missing)} not found, which Dr.Jit needs; install: {install}")
    cache.use_for_kernels()
    given = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if given:
        usable = llvm.is_usable(llvm.identify(Path(given)).major)
    else:
        library = llvm.choose()
        usable = library is not None
        if library is not None:
            os.environ[llvm.ENVIRONMENT_VARIABLE] = str(library.path)
    if not usable and sys.platform == "linux":
        # Dr.Jit will say so on standard error as it is imported, before our one line that also says what to do.
        # Whatever goes wrong here is told by the import that follows.
        with _silent_stderr(), contextlib.suppress(Exception):
            import drjit  # noqa: F401

            time.sleep(_INITIALISATION)  # goes on in a thread after the import


def use(variant: str = "auto") -> str:
    """Select the Mitsuba variant that everything runs on from now on.

    May be called again, also with another variant: scenes and arrays made before stay with the old one and cannot be
    mixed with new ones.

    Args:
        variant: "cuda_ad_rgb", "llvm_ad_rgb", or "auto": CUDA where a GPU works, else LLVM. Whether it works is tried
            once per process, in a process of its own (a few seconds, and only where a driver is installed).

    Returns:
        The variant in use.

    Raises:
        VariantError: there is no such variant, or this machine cannot run it: no working GPU, no LLVM, or one so old
            that it would abort the process. One line, with the command that installs what is missing.
    """
    if variant not in ("auto", *VARIANTS):
        hint = did_you_mean(variant, VARIANTS, likeness=0.3)
        raise VariantError(f"unknown variant {variant!r}: expected 'auto', {CUDA!r} or {LLVM!r}{hint}")
    mi = _mitsuba()
    chosen = variant
    if variant == "auto":
        chosen = CUDA if gpu_problem() is None else LLVM
    if chosen == LLVM:
        _check_llvm()
    elif mi.variant() != CUDA and (problem := gpu_problem()):
        raise VariantError(f"{CUDA} cannot run here: {problem}; {LLVM!r} runs on the CPU")
    with _setting:
        if mi.variant() != chosen:
            try:
                mi.set_variant(chosen)
            except ImportError as error:
                raise VariantError(f"Mitsuba cannot use {chosen}: {reason_of(error)}") from error
            _keep_to_container()
    return chosen


def _keep_to_container() -> None:
    """Let Dr.Jit have no more threads than a container has cores. By itself it counts those of the machine."""
    global _kept
    if _kept:
        return
    _kept = True
    import drjit as dr

    if (cores := limits.cores()) < dr.thread_count():
        dr.set_thread_count(cores)


def check_threads(count: int) -> None:
    """Raise `InputError` for more threads than a few for each core: they take those of all other processes of the machine."""
    cores = limits.cores()
    if count > _THREADS * cores:
        raise InputError(
            f"threads {count}: this process may use {cores} core{'s' * (cores > 1)}; expected at most {_THREADS * cores}"
        )


def use_threads(count: int) -> None:
    """Let that many threads of the processor work, >= 1. Before the first kernel of the process: later, Dr.Jit may crash.

    Raises:
        InputError: they are far more than this process has cores.
    """
    check_threads(count)
    ensure()
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


@contextlib.contextmanager
def two_threads() -> Iterator[None]:
    """Let Dr.Jit have a second thread meanwhile where it has one alone: Mitsuba's OpenEXR would wait for ever to read or write a file."""
    ensure()
    import drjit as dr

    if dr.thread_count() > 1:
        yield
        return
    dr.sync_thread()
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(1)


def current() -> str | None:
    """The variant that Mitsuba is set to, whoever set it; None before any was chosen. Imports nothing."""
    mi = sys.modules.get("mitsuba")
    return None if mi is None else mi.variant()


def ensure() -> str:
    """What library code calls before it touches Mitsuba: keep the variant that is set, once it is known to be safe;
    choose one as `use("auto")` does where none is. Cheap to call again.

    Raises:
        VariantError: as `use`; or a variant is set that `unrender` cannot work with, such as "scalar_rgb".
    """
    name = current()
    if name is None:
        return use()
    if name not in VARIANTS:
        raise VariantError(f"Mitsuba's variant is {name!r}, expected {CUDA!r} or {LLVM!r}: call unrender.use() instead")
    return use(name)


@functools.cache
def gpu_problem() -> str | None:
    """Why no GPU can be used, in one line; None if one works: it traced a few rays against a rectangle just now.

    The trial runs in a process of its own, so that a broken driver cannot take this one down. Cached for the process.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return "CUDA_VISIBLE_DEVICES hides every GPU"
    if not has_cuda_driver():
        return "no NVIDIA driver is installed"
    return _trial_problem(CUDA)


def has_cuda_driver() -> bool:
    """Whether the driver's library is there, loaded or not. Says nothing about whether it works."""
    if os.environ.get("DRJIT_LIBCUDA_PATH"):
        return True
    places = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib/wsl/lib", "/usr/lib64")
    return any(next(Path(place).glob("libcuda.so*"), None) for place in places) or bool(
        ctypes.util.find_library("nvcuda" if sys.platform == "win32" else "cuda")
    )


def llvm_version() -> tuple[int, ...] | None:
    """The version of the LLVM that Dr.Jit has loaded, such as (19, 1, 7); None where it has none.

    Where the library that it was told to load cannot work, or there is none that could, Dr.Jit is not asked: it would wait for its own
    initialisation, whose thread waits in turn, to report the failure, for the interpreter that this call holds.
    """
    given = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if given and not llvm.is_usable(major := llvm.identify(Path(given)).major):
        return None if major is None else (major,)
    if not given and llvm.choose() is None:
        return None
    import drjit as dr

    version = tuple(dr.detail.llvm_version())
    return version if version[0] > 0 else None


def _trial_problem(variant: str) -> str | None:
    code = _GPU_TRIAL.format(path=[os.path.abspath(place) for place in sys.path], variant=variant)
    try:
        trial = subprocess.run(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=120,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the trial on the GPU did not finish ({reason_of(error)})"
    if trial.returncode == 0:
        return None
    lines = [line.strip() for line in trial.stderr.splitlines() if line.strip()]
    return f"the trial on the GPU failed ({lines[-1][:200] if lines else f'exit status {trial.returncode}'})"


def _mitsuba() -> Any:
    """Mitsuba, imported with the right LLVM at hand, and with its own plugins before all others."""
    prepare()
    try:
        import mitsuba
    except ModuleNotFoundError as error:
        raise VariantError(f"{error.name} is not installed; install: pip install 'mitsuba>=3.9.1,<3.10'") from error
    except (ImportError, OSError, NameError) as error:
        # Where a library is missing, Dr.Jit's own import trips over a name while it handles that.
        cause = error.__context__ if isinstance(error, NameError) and error.__context__ else error
        raise VariantError(f"Mitsuba cannot be imported: {reason_of(cause)}") from error
    plugins.prefer_own()
    return mitsuba


def _check_llvm() -> None:
    """Raise `VariantError` unless Dr.Jit has loaded an LLVM that works."""
    version = llvm_version()
    if version is not None and llvm.is_usable(version[0]):
        return
    given = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    what = f"{_llvm_found(version, given)}, unrender needs LLVM {llvm.OLDEST} or newer"
    library = llvm.choose()
    if library is None or (given and Path(given).resolve() == library.path.resolve()):
        raise VariantError(f"{what}; install: {install_hints.command(['llvm'])}")
    first = "" if given else "import unrender first, or "
    raise VariantError(f"{what}; {first}set {llvm.ENVIRONMENT_VARIABLE}={library.path}")


def _llvm_found(version: tuple[int, ...] | None, given: str | None) -> str:
    """What there is instead of an LLVM that works: loaded as `version`, asked for by the path `given`."""
    if given:
        path = Path(given)
        major = version[0] if version else llvm.identify(path).major
        if version is None and llvm.is_usable(major):
            return f"Dr.Jit cannot load {llvm.ENVIRONMENT_VARIABLE}={given}"
        found = f"LLVM {major}" if major else ("no LLVM" if path.exists() else "no such file")
        return f"{llvm.ENVIRONMENT_VARIABLE}={given} is {found}"
    if version is not None and llvm.choose():
        return f"Dr.Jit was imported before unrender and loaded LLVM {version[0]}"
    newest = max((llvm.version_by_name(path) or 0 for path in llvm.candidates()), default=0)
    return f"LLVM {newest} is the newest one here" if newest else "no LLVM library was found"


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Nothing reaches file descriptor 2 meanwhile, from C++ either."""
    try:
        kept = os.dup(2)
    except OSError:  # closed, so silent already
        yield
        return
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
