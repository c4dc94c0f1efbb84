"""Display of a problem as one line of text, and as HTML in a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unrender.display import notebook
from unrender.display.pictures import shown_image, shown_map

if TYPE_CHECKING:
    from unrender.scene.problem import Problem

_VIEWS, _MAPS = 4, 3


def line(problem: Problem) -> str:
    """Return a summary: Problem('indirect-room': back.bsdf.reflectance.data (64, 64, 3); 1 view of 128x128; L1())."""
    shapes = problem.shapes()
    keys = [f"{key} {shapes[key]}" for key in shapes]
    more = [f"and {len(keys) - 3} more"] if len(keys) > 3 else []
    return f"Problem({problem.name!r}: {', '.join([*keys[:3], *more])}; {describe_views(problem)}; {_loss(problem)})"


def html(problem: Problem) -> str:
    """Return HTML with references, initial and true values as images, the unknowns, and the notices on the input."""
    shown = {
        f"reference {index}": shown_image(np.asarray(view.reference))
        for index, view in enumerate(problem.views[:_VIEWS])
    }
    for key, unknown in list(problem.unknowns.items())[:_MAPS]:
        for what, values in (("start", unknown.initial), ("truth", unknown.truth)):
            colours = None if values is None else shown_map(values, unknown.truth)
            if colours is not None:
                shown[f"{what}: {key}"] = colours
    rows = {}
    for key, unknown in problem.unknowns.items():
        shape = unknown.shape()
        low, high = ("open" if side is None else f"{side:g}" for side in unknown.bounds)
        about = [f"shape {shape}" if shape else "a number", f"bounds {low} to {high}"]
        about += [f"learning rate {unknown.learning_rate:g}"] if unknown.learning_rate is not None else []
        about += [f"{own!r:.80}" for own in (unknown.preconditioner, unknown.parameterisation) if own is not None]
        rows[key] = ", ".join(about)
    title = f"Problem {problem.name}: {describe_views(problem)}, {_loss(problem)}, up to {problem.max_depth} segments"
    return notebook.block(
        title, notebook.picture_row(shown), notebook.facts(rows), notebook.lines(problem.notices, "note: ")
    )


def describe_views(problem: Problem) -> str:
    """Return the number and sizes of the views: 2 views of 128x128."""
    sizes = sorted({(width, height) for height, width in problem.sizes})
    size = ", ".join(f"{width}x{height}" for width, height in sizes)
    return f"{len(problem.views)} view{'s' if len(problem.views) > 1 else ''} of {size}"


def _loss(problem: Problem) -> str:
    return f"{problem.loss!r:.60}".replace("\n", " ")
