"""unrender: recover what a scene is made of from images of it.

    import unrender as ur

    problem = ur.gallery.problem("indirect-room")
    estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=1e-2), steps=300)
    result.save("out")

Names are loaded when first used, so that `import unrender` is quick and works where Mitsuba does not (yet).
"""

# ruff: noqa: E402
from unrender.core.signals import end_at_once as _end_at_once

_end_at_once()  # before anything that takes time

from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from unrender.backend import variant as _variant
from unrender.backend.variant import use
from unrender.core.errors import InputError, UnrenderError, VariantError

if TYPE_CHECKING:
    from unrender import (
        gallery,
        images,
        losses,
        optimizers,
        parameterisations,
        pixels,
        preconditioners,
        protocols,
        schedules,
        statistics,
    )
    from unrender.app import report as report
    from unrender.app.capture.importing import ImportOptions, import_capture
    from unrender.app.cli.sweep_function import sweep
    from unrender.app.distributed.deal import deal
    from unrender.app.evaluation.judge import judge
    from unrender.app.evaluation.turntable import turntable
    from unrender.app.exporting.scene_folder import export
    from unrender.core.random import Key
    from unrender.core.registry import register
    from unrender.estimators import smoothing as smoothed
    from unrender.estimators.base import Estimate
    from unrender.estimators.filtered import FilteredGradient
    from unrender.estimators.gauss_newton import GaussNewton
    from unrender.estimators.hybrid import HybridGradient
    from unrender.estimators.loss_values import LossValues
    from unrender.estimators.meta import MetaEstimator
    from unrender.estimators.path import PathGradient
    from unrender.estimators.smoothed import SmoothedDerivatives
    from unrender.estimators.smoothing import grey_box as grey_box
    from unrender.estimators.stock import StockGradient
    from unrender.io.volumes import Grid, read_grid, write_grid
    from unrender.losses import metrics
    from unrender.own_loop.renderer import Renderer
    from unrender.runs.callbacks import Callback
    from unrender.runs.live import Live
    from unrender.runs.optimize import estimate, optimize
    from unrender.runs.reopen import resume
    from unrender.runs.result import Result
    from unrender.runs.sensitivity import sensitivity
    from unrender.runs.tensorboard import TensorBoard
    from unrender.scene.coarse_to_fine import CoarseToFine
    from unrender.scene.parameter import Parameter
    from unrender.scene.problem import Problem
    from unrender.scene.render import render, render_pair
    from unrender.scene.view import View

_MODULES = {
    "gallery": "gallery",
    "grey_box": "estimators.smoothing.grey_box",
    "images": "images",
    "losses": "losses",
    "metrics": "losses.metrics",
    "optimizers": "optimizers",
    "parameterisations": "parameterisations",
    "pixels": "pixels",
    "preconditioners": "preconditioners",
    "protocols": "protocols",
    "report": "app.report",
    "schedules": "schedules",
    "smoothed": "estimators.smoothing",
    "statistics": "statistics",
}
_HOMES = {
    "Callback": "runs.callbacks",
    "CoarseToFine": "scene.coarse_to_fine",
    "Estimate": "estimators.base",
    "FilteredGradient": "estimators.filtered",
    "GaussNewton": "estimators.gauss_newton",
    "Grid": "io.volumes",
    "HybridGradient": "estimators.hybrid",
    "ImportOptions": "app.capture.importing",
    "Key": "core.random",
    "Live": "runs.live",
    "LossValues": "estimators.loss_values",
    "MetaEstimator": "estimators.meta",
    "Parameter": "scene.parameter",
    "PathGradient": "estimators.path",
    "Problem": "scene.problem",
    "Renderer": "own_loop.renderer",
    "Result": "runs.result",
    "SmoothedDerivatives": "estimators.smoothed",
    "StockGradient": "estimators.stock",
    "TensorBoard": "runs.tensorboard",
    "View": "scene.view",
    "deal": "app.distributed.deal",
    "estimate": "runs.optimize",
    "export": "app.exporting.scene_folder",
    "import_capture": "app.capture.importing",
    "judge": "app.evaluation.judge",
    "optimize": "runs.optimize",
    "read_grid": "io.volumes",
    "register": "core.registry",
    "render": "scene.render",
    "render_pair": "scene.render",
    "resume": "runs.reopen",
    "sensitivity": "runs.sensitivity",
    "sweep": "app.cli.sweep_function",
    "turntable": "app.evaluation.turntable",
    "write_grid": "io.volumes",
}

with suppress(VariantError):  # said again, in one line, by whatever needs Mitsuba first
    _variant.prepare()  # before anything imports Dr.Jit, which reads the choice of LLVM once

# Without grey_box, which needs PyTorch: `from unrender import *` and `help(unrender)` must work where that is missing.
__all__ = [
    "Callback",
    "CoarseToFine",
    "Estimate",
    "FilteredGradient",
    "GaussNewton",
    "Grid",
    "HybridGradient",
    "ImportOptions",
    "InputError",
    "Key",
    "Live",
    "LossValues",
    "MetaEstimator",
    "Parameter",
    "PathGradient",
    "Problem",
    "Renderer",
    "Result",
    "SmoothedDerivatives",
    "StockGradient",
    "TensorBoard",
    "UnrenderError",
    "VariantError",
    "View",
    "deal",
    "estimate",
    "export",
    "gallery",
    "images",
    "import_capture",
    "judge",
    "losses",
    "metrics",
    "optimize",
    "optimizers",
    "parameterisations",
    "pixels",
    "preconditioners",
    "protocols",
    "read_grid",
    "register",
    "render",
    "render_pair",
    "report",
    "resume",
    "schedules",
    "sensitivity",
    "smoothed",
    "statistics",
    "sweep",
    "turntable",
    "use",
    "write_grid",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES or name in _HOMES:
        _variant.prepare()
        if name in _MODULES:
            return import_module(f"unrender.{_MODULES[name]}")
        value = getattr(import_module(f"unrender.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'unrender' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
