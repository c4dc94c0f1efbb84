"""unrender: recover what a scene is made of from images of it.

    import unrender as ur

    problem = ur.gallery.problem("indirect-room")
    estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=1e-2), steps=300)
    result.save("out")

Names are loaded when first used, so that `import unrender` is quick and works where Mitsuba does not (yet).
"""

from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from unrender import variant as _variant
from unrender.errors import InputError, UnrenderError, VariantError
from unrender.variant import use

if TYPE_CHECKING:
    from unrender import gallery, images, losses, optimizers, pixels, preconditioners, report, smoothed, statistics
    from unrender import grey_box as grey_box
    from unrender import metrics as metrics
    from unrender.exporting.folder import export
    from unrender.gradients.black_box import LossValues
    from unrender.gradients.estimate import Estimate
    from unrender.gradients.meta import MetaEstimator
    from unrender.gradients.path import PathGradient
    from unrender.gradients.smoothed import SmoothedDerivatives
    from unrender.keys import Key
    from unrender.problem.coarse_to_fine import CoarseToFine
    from unrender.problem.grids import Grid, read_grid, write_grid
    from unrender.problem.parameter import Parameter
    from unrender.problem.problem import Problem
    from unrender.problem.render import render, render_pair
    from unrender.problem.view import View
    from unrender.reopen import resume
    from unrender.training.callbacks import Callback
    from unrender.training.live import Live
    from unrender.training.loop import estimate, optimize
    from unrender.training.result import Result
    from unrender.training.tensorboard import TensorBoard

_MODULES = (
    "gallery",
    "grey_box",
    "images",
    "losses",
    "metrics",
    "optimizers",
    "pixels",
    "preconditioners",
    "report",
    "smoothed",
    "statistics",
)
_HOMES = {
    "Callback": "training.callbacks",
    "CoarseToFine": "problem.coarse_to_fine",
    "Estimate": "gradients.estimate",
    "Grid": "problem.grids",
    "Key": "keys",
    "Live": "training.live",
    "LossValues": "gradients.black_box",
    "MetaEstimator": "gradients.meta",
    "Parameter": "problem.parameter",
    "PathGradient": "gradients.path",
    "Problem": "problem.problem",
    "Result": "training.result",
    "SmoothedDerivatives": "gradients.smoothed",
    "TensorBoard": "training.tensorboard",
    "View": "problem.view",
    "estimate": "training.loop",
    "export": "exporting.folder",
    "optimize": "training.loop",
    "read_grid": "problem.grids",
    "render": "problem.render",
    "render_pair": "problem.render",
    "resume": "reopen",
    "write_grid": "problem.grids",
}

with suppress(VariantError):  # said again, in one line, by whatever needs Mitsuba first
    _variant.prepare()  # before anything imports Dr.Jit, which reads the choice of LLVM once

# Without grey_box, which needs PyTorch: `from unrender import *` and `help(unrender)` must work where that is missing.
__all__ = [
    "Callback",
    "CoarseToFine",
    "Estimate",
    "Grid",
    "InputError",
    "Key",
    "Live",
    "LossValues",
    "MetaEstimator",
    "Parameter",
    "PathGradient",
    "Problem",
    "Result",
    "SmoothedDerivatives",
    "TensorBoard",
    "UnrenderError",
    "VariantError",
    "View",
    "estimate",
    "export",
    "gallery",
    "images",
    "losses",
    "metrics",
    "optimize",
    "optimizers",
    "pixels",
    "preconditioners",
    "read_grid",
    "render",
    "render_pair",
    "report",
    "resume",
    "smoothed",
    "statistics",
    "use",
    "write_grid",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES or name in _HOMES:
        _variant.prepare()
        if name in _MODULES:
            return import_module(f"unrender.{name}")
        value = getattr(import_module(f"unrender.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'unrender' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
