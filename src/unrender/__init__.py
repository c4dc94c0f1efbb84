"""unrender: inverse rendering on Mitsuba 3. Recovers parameters of a scene from images.

    import unrender as ur

    problem = ur.gallery.problem("indirect-room")
    estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=1e-2), steps=300)
    result.save("out")

Names are loaded when first used, so that `import unrender` is quick and works without a usable Mitsuba.
"""

# ruff: noqa: E402
from unrender.core.signals import end_at_once as _end_at_once

_end_at_once()  # must precede slow imports

import warnings
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from unrender.backend import variant as _variant
from unrender.backend.variant import use
from unrender.core.errors import InputError, UnrenderError, VariantError

if TYPE_CHECKING:
    from unrender import app as app
    from unrender import estimators as estimators
    from unrender import gallery, images, losses, optimizers, pixels, preconditioners, statistics
    from unrender import io as io
    from unrender import parameterisations as parameterisations
    from unrender import protocols as protocols
    from unrender import runs as runs
    from unrender import scene as scene
    from unrender import schedules as schedules
    from unrender.core.registry import register
    from unrender.estimators import smoothing as smoothed
    from unrender.estimators.base import Estimate
    from unrender.estimators.gauss_newton import GaussNewton
    from unrender.estimators.meta import MetaEstimator
    from unrender.estimators.path import PathGradient
    from unrender.estimators.smoothed import SmoothedDerivatives
    from unrender.estimators.smoothing import grey_box as grey_box
    from unrender.own_loop.renderer import Renderer
    from unrender.runs.optimize import estimate, optimize
    from unrender.runs.reopen import resume
    from unrender.runs.result import Result
    from unrender.scene.parameter import Parameter
    from unrender.scene.problem import Problem
    from unrender.scene.references import View
    from unrender.scene.render import render, render_pair

_PACKAGES = (
    *("app", "estimators", "gallery", "images", "io", "losses", "optimizers", "parameterisations", "pixels"),
    *("preconditioners", "protocols", "runs", "scene", "schedules", "statistics"),
)
_MODULES = {name: name for name in _PACKAGES} | {
    "grey_box": "estimators.smoothing.grey_box",
    "smoothed": "estimators.smoothing",
}
"""{attribute: module}. Each is imported at its first use."""
_HOMES = {
    "Estimate": "estimators.base",
    "GaussNewton": "estimators.gauss_newton",
    "MetaEstimator": "estimators.meta",
    "Parameter": "scene.parameter",
    "PathGradient": "estimators.path",
    "Problem": "scene.problem",
    "Renderer": "own_loop.renderer",
    "Result": "runs.result",
    "SmoothedDerivatives": "estimators.smoothed",
    "View": "scene.references",
    "estimate": "runs.optimize",
    "optimize": "runs.optimize",
    "register": "core.registry",
    "render": "scene.render",
    "render_pair": "scene.render",
    "resume": "runs.reopen",
}
_MOVED = {
    "Callback": "protocols.Callback",
    "CoarseToFine": "scene.CoarseToFine",
    "Grid": "io.Grid",
    "HybridGradient": "estimators.HybridGradient",
    "ImportOptions": "app.ImportOptions",
    "Key": "core.random.Key",
    "Live": "runs.Live",
    "LossValues": "estimators.LossValues",
    "StockGradient": "estimators.StockGradient",
    "deal": "app.distribute",
    "export": "app.export",
    "import_capture": "app.import_capture",
    "judge": "app.judge",
    "metrics": "losses.metrics",
    "read_grid": "io.read_grid",
    "report": "app.report",
    "sensitivity": "runs.sensitivity",
    "sweep": "app.sweep",
    "turntable": "app.turntable",
    "write_grid": "io.write_grid",
}
"""{former name: present name}. Former names emit a `DeprecationWarning`; version 0.2 removes them."""

with suppress(VariantError):  # the first use of Mitsuba raises it again
    _variant.prepare()  # must precede the import of Dr.Jit, which chooses LLVM once

# The names that a first script needs. `from unrender import *` leaves out the other modules of `_MODULES`.
__all__ = [
    "Estimate",
    "GaussNewton",
    "InputError",
    "MetaEstimator",
    "Parameter",
    "PathGradient",
    "Problem",
    "Renderer",
    "Result",
    "SmoothedDerivatives",
    "UnrenderError",
    "VariantError",
    "View",
    "estimate",
    "gallery",
    "images",
    "losses",
    "optimize",
    "optimizers",
    "pixels",
    "preconditioners",
    "register",
    "render",
    "render_pair",
    "resume",
    "smoothed",
    "statistics",
    "use",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        _variant.prepare()
        return import_module(f"unrender.{_MODULES[name]}")
    if name in _HOMES:
        _variant.prepare()
        value = getattr(import_module(f"unrender.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    if name in _MOVED:
        warnings.warn(f"unrender.{name} is now unrender.{_MOVED[name]}", DeprecationWarning, stacklevel=2)
        module, _, own = _MOVED[name].rpartition(".")
        _variant.prepare()
        home = import_module(f"unrender.{module}")
        return getattr(home, own) if hasattr(home, own) else import_module(f"unrender.{_MOVED[name]}")
    raise AttributeError(f"module 'unrender' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES})
