"""unrender: recover what a scene is made of from images of it.

    import unrender as ur

    problem = ur.gallery.problem("indirect-room")
    estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=5e-3), steps=300)
    result.save("out")
"""

from unrender import variant as _variant

_variant.prepare()  # before anything imports Dr.Jit, which reads the choice of LLVM once

from unrender import gallery, images, losses, optimizers, pixels, preconditioners, report, statistics  # noqa: E402
from unrender.errors import InputError, UnrenderError, VariantError  # noqa: E402
from unrender.gradients.estimate import Estimate  # noqa: E402
from unrender.gradients.path import PathGradient  # noqa: E402
from unrender.keys import Key  # noqa: E402
from unrender.problem.parameter import Parameter  # noqa: E402
from unrender.problem.problem import Problem  # noqa: E402
from unrender.problem.view import View  # noqa: E402
from unrender.problem.render import render, render_pair  # noqa: E402
from unrender.training.callbacks import Callback  # noqa: E402
from unrender.training.loop import estimate, optimize  # noqa: E402
from unrender.training.result import Result  # noqa: E402
from unrender.variant import use  # noqa: E402

__all__ = [
    "Callback",
    "Estimate",
    "InputError",
    "Key",
    "Parameter",
    "PathGradient",
    "Problem",
    "Result",
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
    "render",
    "render_pair",
    "report",
    "statistics",
    "use",
]
