"""`unrender doctor`: properties of this machine, a gradient test, and missing packages."""

from __future__ import annotations

import os
import platform
import re
import sys
from importlib import metadata

from rich.markup import escape

from unrender.backend import cache, limits, llvm, variant, versions
from unrender.core.errors import VariantError
from unrender.display.terminal import Console, columns

TOLERANCE = 1e-3
"""Maximum relative error of the test gradient. Both sides use the same paths, so only rounding errors remain."""

_FEATURES = {
    "capture": "photographs, glTF, .mp4",
    "remesh": "remeshing",
    "ray": "workers",
    "sweep": "sweeps by tpe",
    "denoise": "denoised images on the CPU",
    "flip": "the measure FLIP",
    "torch": "functions behind a network, perceptual losses",
    "dev": "tests of this package",
    "docs": "its documentation",
}
"""{extra: its purpose}."""

_STEP = 0.05
_RESOLUTION = 16
_SPP = 64
_SEED = 1


def doctor(console: Console | None = None) -> int:
    """Print versions, hardware, the selected backend, a gradient test against finite differences, and missing packages. Return the exit
    status: 0 if everything that is needed works, else 3."""
    console = console or Console()
    problem: str | None = None
    backend = "none"
    error: float | None = None
    try:
        backend = variant.use()
        error = gradient_error()
    except VariantError as unusable:
        problem = str(unusable)
    table = columns()
    for name, value in [*_versions(), *_hardware(), *_cache(), ("backend", backend)]:
        table.add_row(name, escape(value))
    if error is not None:
        good = error <= TOLERANCE
        verdict = "[green]right[/]" if good else "[red]wrong[/]"
        table.add_row("gradient", f"{verdict}: relative error {error:.1e} against finite differences")
        if not good:
            problem = f"the gradient is off by {error:.1e}, more than {TOLERANCE:g}; please report it with these lines"
    console.print(table)
    for line in _missing():
        console.print(f"[yellow]missing[/] {escape(line)}", soft_wrap=True)
    if problem:
        console.print(f"[red]problem[/] {escape(problem)}", soft_wrap=True)
        return 3
    console.print("[green]Everything needed is here.[/]")
    return 0


def gradient_error() -> float:
    """Return the relative error of path replay against central differences on the same paths. A variant must be active.

    The derivative is that of the mean of a Cornell box's image by the red wall's albedo, summed over the albedo's channels. The mean is
    a cubic polynomial of the albedo at this depth, so the error of the differences is about 1e-4.
    """
    import drjit as dr
    import mitsuba as mi

    description = mi.cornell_box()
    description["sensor"]["film"].update(width=_RESOLUTION, height=_RESOLUTION)
    # Four segments avoid Russian roulette, which begins at five and would select other paths for another albedo.
    description["integrator"] = {"type": "prb", "max_depth": 4}
    scene = mi.load_dict(description)
    parameters = mi.traverse(scene)
    integrator, key = scene.integrator(), "red.reflectance.value"
    albedo = mi.Color3f(parameters[key])

    def brightness(shift: float) -> float:
        parameters[key] = albedo + shift
        parameters.update()
        return float(dr.mean(integrator.render(scene, seed=_SEED, spp=_SPP), axis=None).array[0])

    expected = (brightness(_STEP) - brightness(-_STEP)) / (2 * _STEP)
    parameters[key] = mi.Color3f(albedo)
    dr.enable_grad(parameters[key])
    parameters.update()
    shape = (_RESOLUTION, _RESOLUTION, 3)
    weights = dr.full(mi.TensorXf, 1 / (_RESOLUTION * _RESOLUTION * 3), shape)
    integrator.render_backward(scene, parameters, weights, seed=_SEED, spp=_SPP)
    replayed = float(dr.sum(mi.Color3f(dr.grad(parameters[key])))[0])
    return abs(replayed - expected) / abs(expected)


def _versions() -> list[tuple[str, str]]:
    rows = [("python", f"{platform.python_version()} ({sys.executable})"), ("system", _system())]
    rows += [
        (name, _version(name) or "not installed as a package") for name in ("unrender", "mitsuba", "drjit", "numpy")
    ]
    return [*rows, ("LLVM", _llvm())]


def _system() -> str:
    if sys.platform == "darwin":
        return f"macOS {platform.mac_ver()[0]}"
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        return platform.platform()


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _llvm() -> str:
    path = os.environ.get(llvm.ENVIRONMENT_VARIABLE, "chosen by Dr.Jit")
    if "drjit" not in sys.modules:
        return "not loaded"
    version = variant.llvm_version()
    if version is None:
        return f"none ({path})" if llvm.ENVIRONMENT_VARIABLE in os.environ else "none"
    remark = f", newer than {llvm.NEWEST}, the newest that was tried" if version[0] > llvm.NEWEST else ""
    return f"{'.'.join(map(str, version))} ({path}{remark})"


def _hardware() -> list[tuple[str, str]]:
    problem = variant.gpu_problem()
    gpu = limits.first_line("nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
    cores = limits.cores()
    return [
        ("CPU", f"{versions.processor()}, {cores} core{'s' if cores > 1 else ''}"),
        ("GPU", (gpu or "CUDA works") if problem is None else f"not used: {problem}" + (f" ({gpu})" if gpu else "")),
    ]


def _cache() -> list[tuple[str, str]]:
    place = cache.root()
    if place is None:
        return [("cache", f"switched off ({cache.ENVIRONMENT_VARIABLE} is empty)")]
    if cache.folder(cache.REFERENCES) is None:
        return [
            (
                "cache",
                f"{place} cannot be written, so nothing is cached; set {cache.ENVIRONMENT_VARIABLE} to another folder",
            )
        ]
    sizes = ", ".join(f"{part} {cache.size(part) / 1e6:.0f} MB" for part in (cache.REFERENCES, cache.KERNELS))
    return [("cache", f"{place} ({sizes})")]


def _missing() -> list[str]:
    """Return one line per optional feature with missing packages that support this Python, with pip's command, which needs no index."""
    from packaging.requirements import InvalidRequirement, Requirement

    try:
        required = metadata.requires("unrender") or []
    except metadata.PackageNotFoundError:
        return []
    absent: set[str] = set()
    for text in required:
        try:
            requirement = Requirement(text)
        except InvalidRequirement:
            continue
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", text)
        if extra is None or _version(requirement.name) is not None:
            continue
        if requirement.marker is not None and requirement.marker.evaluate({"extra": extra[1]}):
            absent.add(extra[1])
    return [
        f"(optional, {_FEATURES.get(extra, extra)}) install: pip install 'unrender[{extra}]'"
        for extra in sorted(absent)
    ]
