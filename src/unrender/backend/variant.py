"""Choice of the Mitsuba variant: a GPU if one works, else the CPU with a supported LLVM.

Only this module calls `mitsuba.set_variant`. `unrender` runs no kernel before `ensure()` or `use()` has returned.
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
from unrender.core.exclusive import exclusive
from unrender.core.text import did_you_mean, in_words, reason_of

CUDA = "cuda_ad_rgb"
LLVM = "llvm_ad_rgb"
VARIANTS = (CUDA, LLVM, "cuda_ad_spectral", "llvm_ad_spectral")
"""Supported variants: RGB or spectral, differentiable, unpolarised."""
_EXPECTED = f"expected 'auto', {', '.join(map(repr, VARIANTS[:-1]))} or {VARIANTS[-1]!r}"

_INITIALISATION = 0.5  # maximum time in seconds that Dr.Jit takes to reject a library
_THREADS = 4  # maximum number of threads per core

_threads_limited = False
_loading_process: int | None = None  # process of the first load, which has Dr.Jit's threads; forks inherit its number
_setting = threading.RLock()  # Mitsuba's module attributes are incomplete while another thread sets the variant

_TRIAL = """
import os, sys
sys.path[:] = {path!r}
import drjit as dr, mitsuba as mi
mi.file_resolver().prepend(os.path.dirname(mi.__file__))  # see plugins.py
mi.set_variant({variant!r})
"""

_RAYS = """
scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}})
rays = mi.Ray3f(mi.Point3f(dr.linspace(mi.Float, -0.5, 0.5, 8), 0, 2), mi.Vector3f(0, 0, -1))
assert dr.allclose(scene.ray_intersect_preliminary(rays).t, 2)
"""


def prepare() -> None:
    """Choose the LLVM library that Dr.Jit will load. Must be called before the first `import drjit` of the process.

    Dr.Jit reads `DRJIT_LIBLLVM_PATH` once, on import. Without it, Dr.Jit loads the first library it finds, even one that aborts later. So
    this function sets the variable to the newest supported library, unless the user has set it (`use` checks that one). It sets
    `DRJIT_CACHE_DIR`, the folder of compiled kernels, in the same manner. It loads no library and runs no kernel, and does nothing once
    Dr.Jit is imported.

    Raises:
        VariantError: a system library is missing without which Dr.Jit cannot be imported.
    """
    if "drjit" in sys.modules:
        return
    if missing := llvm.missing_companions():
        install = install_hints.command(missing)
        raise VariantError(f"{' and '.join(missing)} not found, which Dr.Jit needs; install: {install}")
    cache.use_for_kernels()
    chosen = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if chosen:
        usable = llvm.is_usable(llvm.identify(Path(chosen)).major)
    else:
        library = llvm.choose()
        usable = library is not None
        if library is not None:
            os.environ[llvm.ENVIRONMENT_VARIABLE] = str(library.path)
    if not usable and sys.platform == "linux":
        # Dr.Jit prints its own message on import, before the one-line error that also says what to do. The later import reports any
        # failure of this one.
        with _silent_stderr(), contextlib.suppress(Exception):
            import drjit  # noqa: F401

            time.sleep(_INITIALISATION)  # a thread continues after the import


def use(variant: str = "auto") -> str:
    """Select the Mitsuba variant for all later computation.

    A later call may select another variant. Existing scenes and arrays stay with the old variant and cannot be mixed with new ones.

    Args:
        variant: one of `VARIANTS`, or "auto", which is "cuda_ad_rgb" if a GPU works and "llvm_ad_rgb" otherwise. A GPU is tested once
            per process, in a separate process. The test takes a few seconds, and only runs if a driver is installed.

    Returns:
        The selected variant.

    Raises:
        VariantError: the variant does not exist, or this machine cannot run it: no working GPU, no LLVM, or an LLVM that is so old
            that it would abort the process. The message contains the command that installs what is missing.
    """
    if refusal := unsupported(variant):
        raise VariantError(refusal)
    mi = _mitsuba()
    chosen = variant
    if variant == "auto":
        chosen = CUDA if gpu_problem() is None else LLVM
    if not is_on_gpu(chosen):
        _check_llvm()
    elif not is_on_gpu(mi.variant()) and (problem := gpu_problem()):
        on_cpu = chosen.replace("cuda", "llvm", 1)
        raise VariantError(f"{chosen} cannot run here: {problem}; {on_cpu!r} runs on the CPU")
    with _setting:
        if mi.variant() != chosen:
            try:
                mi.set_variant(chosen)
            except ImportError as error:
                raise VariantError(f"Mitsuba cannot use {chosen}: {reason_of(error)}") from error
            _limit_threads()
    return chosen


def is_on_gpu(variant: str | None) -> bool:
    """Return whether a variant runs on a GPU. False for None."""
    return variant is not None and variant.startswith("cuda")


def is_gpu() -> bool:
    """Return whether the current variant runs on a GPU, which differs in what would change results.

    A bitmap or grid lies in texture memory, which holds a copy of the parameter. After one backward pass the leaf gets no gradient from
    the copy, so each pass needs a new leaf. A lookup with a mask selects between the texture and a null pointer, which Dr.Jit cannot
    record outside a virtual call and ends the process. Texture units interpolate with 8-bit weights; `accel = false` would avoid all
    this, but then Dr.Jit 1.5 reads an uninitialised handle while it records.

    A kernel traces rays in one OptiX scene only. With a second scene the rays of both meet the first one's shapes, and Dr.Jit only
    prints a warning.
    """
    return is_on_gpu(current())


def lookup_mask(active: Any) -> Any:
    """Return the mask of a texture lookup outside a virtual call. On a GPU there is none, so the caller discards inactive lanes."""
    return True if is_gpu() else active


def same_colours(variant: str, other: str) -> bool:
    """Return whether two variants render the same colours: both RGB, or both spectral."""
    return variant.endswith("spectral") == other.endswith("spectral")


def with_colours_of(variant: str, other: str | None) -> str:
    """Return the variant for the device of `variant` that renders the colours of `other`; `variant` itself for None."""
    return next(v for v in VARIANTS if v[:4] == variant[:4] and same_colours(v, other or variant))


def unsupported(variant: str) -> str:
    """Return why a name is neither "auto" nor a supported variant, and what was expected, in one line; "" if it is."""
    name = variant if isinstance(variant, str) else in_words(variant)
    return "" if name in ("auto", *VARIANTS) else f"{_lacking(name)}{_EXPECTED}"


def _lacking(variant: str) -> str:
    parts = variant.split("_")
    if parts[0] not in ("scalar", "llvm", "cuda", "metal"):
        return f"unknown variant {variant!r}{did_you_mean(variant, VARIANTS, likeness=0.3)}: "
    what = {"polarized": "polarised rendering", "mono": "monochromatic rendering"}
    lacks = [name for part, name in what.items() if part in parts] or [f"variants of {parts[0]!r}"]
    return f"{variant!r} is not supported, since unrender has no {' and no '.join(lacks)}: "


def _limit_threads() -> None:
    """Limit Dr.Jit's threads to the container's cores. Dr.Jit counts the cores of the machine."""
    global _threads_limited
    if _threads_limited:
        return
    _threads_limited = True
    import drjit as dr

    if (cores := limits.cores()) < dr.thread_count():
        dr.set_thread_count(cores)


def check_threads(count: int) -> None:
    """Raise `InputError` for more than four threads per core, which would slow down all processes of the machine."""
    cores = limits.cores()
    if count > _THREADS * cores:
        raise InputError(
            f"threads {count}: this process may use {cores} core{'s' * (cores > 1)}; expected at most {_THREADS * cores}"
        )


def use_threads(count: int) -> None:
    """Set the number of Dr.Jit's CPU threads, >= 1, before the first kernel of the process; later, Dr.Jit may crash. Raises `InputError`
    for more than four per core."""
    check_threads(count)
    ensure()
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


def _is_exr(file: Path) -> bool:
    if file.suffix.lower() == ".exr" or not file.is_file():
        return file.suffix.lower() == ".exr"
    with file.open("rb") as handle:
        return handle.read(4) == b"v/1\x01"


@contextlib.contextmanager
def two_threads(*files: str | Path) -> Iterator[None]:
    """Give Dr.Jit at least two threads within this context if one of the files is an OpenEXR: with one, Mitsuba deadlocks on it.

    A change of their number while another thread of Python renders would deadlock, too: the context waits for its turn.

    Raises:
        InputError: another thread's run goes on, or the threads are those of a parent process and do not exist in this fork of it.
    """
    global _loading_process
    ensure()
    import drjit as dr

    _loading_process = _loading_process or os.getpid()
    if not any(map(_is_exr, map(Path, files))):
        yield
        return
    if dr.thread_count() > 1:
        if _loading_process != os.getpid():
            raise InputError(
                "this process is a fork of one that has used Mitsuba, and OpenEXR files would wait for that process' threads for ever; "
                "start it by multiprocessing.get_context('spawn')"
            )
        yield
        return
    with exclusive("a picture or scene file, with one thread of Dr.Jit"):
        dr.sync_thread()
        dr.set_thread_count(2)
        try:
            yield
        finally:
            dr.sync_thread()
            dr.set_thread_count(1)


def current() -> str | None:
    """Return Mitsuba's current variant, or None if none is set. Imports nothing."""
    mi = sys.modules.get("mitsuba")
    return None if mi is None else mi.variant()


def ensure() -> str:
    """Return the current variant after checking that it is supported, or select one as `use("auto")` does.

    Library code calls this before it uses Mitsuba. Repeated calls are cheap.

    Raises:
        VariantError: as in `use`, or the current variant is one that `unrender` does not support, such as "scalar_rgb".
    """
    name = current()
    if name is None:
        return use()
    if unsupported(name):
        raise VariantError(
            f"Mitsuba's variant: {_lacking(name).removesuffix(': ')}; call unrender.use(), which chooses one"
        )
    return use(name)


@functools.cache
def gpu_problem() -> str | None:
    """Return the reason why no GPU can be used, in one line; None if a GPU works.

    The test traces a few rays against a rectangle in a separate process, so that a broken driver cannot crash this one. Cached for the
    process.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return "CUDA_VISIBLE_DEVICES hides every GPU"
    if not has_cuda_driver():
        return "no NVIDIA driver is installed"
    return gpu_trial()


def has_cuda_driver() -> bool:
    """Return whether the CUDA driver's library is installed. It need not work."""
    if os.environ.get("DRJIT_LIBCUDA_PATH"):
        return True
    places = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib/wsl/lib", "/usr/lib64")
    return any(next(Path(place).glob("libcuda.so*"), None) for place in places) or bool(
        ctypes.util.find_library("nvcuda" if sys.platform == "win32" else "cuda")
    )


def llvm_version() -> tuple[int, ...] | None:
    """Return the version of the LLVM that Dr.Jit has loaded, such as (19, 1, 7); None if there is none.

    If the configured library is unusable, the result is its major version (n,), or None if that is unknown. None also means that no
    usable library exists. Dr.Jit is not asked in these cases. It would deadlock: it waits for its own initialisation, whose thread waits
    for the interpreter lock of this call to report the failure.
    """
    library = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if library and not llvm.is_usable(major := llvm.identify(Path(library)).major):
        return None if major is None else (major,)
    if not library and llvm.choose() is None:
        return None
    import drjit as dr

    version = tuple(dr.detail.llvm_version())
    return version if version[0] > 0 else None


def gpu_trial(statements: str = _RAYS, variant: str = CUDA) -> str | None:
    """Return why statements on `dr` and `mi` fail on the GPU, in one line; None if they do not. They run in a separate process."""
    code = _TRIAL.format(path=[os.path.abspath(place) for place in sys.path], variant=variant) + statements
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
    """Import Mitsuba with the chosen LLVM library, and put its own plugins first."""
    prepare()
    try:
        import mitsuba
    except ModuleNotFoundError as error:
        raise VariantError(f"{error.name} is not installed; install: pip install 'mitsuba>=3.9.1,<3.10'") from error
    except (ImportError, OSError, NameError) as error:
        # If a library is missing, Dr.Jit's import raises NameError while it handles the original error.
        cause = error.__context__ if isinstance(error, NameError) and error.__context__ else error
        raise VariantError(f"Mitsuba cannot be imported: {reason_of(cause)}") from error
    plugins.prefer_own()
    return mitsuba


def _check_llvm() -> None:
    version = llvm_version()
    if version is not None and llvm.is_usable(version[0]):
        return
    chosen = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    what = f"{_describe_llvm(version, chosen)}, unrender needs LLVM {llvm.OLDEST} or newer"
    library = llvm.choose()
    if library is None or (chosen and Path(chosen).resolve() == library.path.resolve()):
        raise VariantError(f"{what}; install: {install_hints.command(['llvm'])}")
    first = "" if chosen else "import unrender first, or "
    raise VariantError(f"{what}; {first}set {llvm.ENVIRONMENT_VARIABLE}={library.path}")


def _describe_llvm(version: tuple[int, ...] | None, library: str | None) -> str:
    if library:
        path = Path(library)
        major = version[0] if version else llvm.identify(path).major
        if version is None and llvm.is_usable(major):
            return f"Dr.Jit cannot load {llvm.ENVIRONMENT_VARIABLE}={library}"
        actual = f"LLVM {major}" if major else ("not LLVM" if path.exists() else "no such file")
        return f"{llvm.ENVIRONMENT_VARIABLE}={library} is {actual}"
    if version is not None and llvm.choose():
        return f"Dr.Jit was imported before unrender and loaded LLVM {version[0]}"
    newest = max((llvm.version_by_name(path) or 0 for path in llvm.candidates()), default=0)
    return f"LLVM {newest} is the newest one here" if newest else "no LLVM library was found"


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard what is written to file descriptor 2 within this context, including output from C++."""
    try:
        original = os.dup(2)
    except OSError:  # closed, so silent already
        yield
        return
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)
