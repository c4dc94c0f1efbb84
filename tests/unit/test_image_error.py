"""The error of pictures that `unrender run` tells, where their noise is not known."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from unrender.runs.result import Result


@pytest.mark.mitsuba
def test_pixels_that_masks_leave_out_do_not_count() -> None:
    from unrender.app.cli.execute import image_error

    reference = np.zeros((2, 3, 3), np.float32)
    shown = reference + 0.5
    shown[:, 0] = 7.0  # a background that no mask counts
    mask = np.array([[0, 1, 1], [0, 0.5, 1]], np.float32)
    result: Any = SimpleNamespace(
        problem={"views": 2},
        image_errors={},
        pictures={f"view{v}/{name}": x for v in range(2) for name, x in (("result", shown), ("reference", reference))},
    )
    assert image_error(result) != "0.5 with noise"
    result.pictures["view0/mask"] = mask
    assert image_error(result) != "0.5 with noise"
    result.pictures["view1/mask"] = mask
    assert image_error(result) == "0.5 with noise"
    result.problem["views"] = 4  # of large problems some views alone have final pictures
    assert image_error(result) == "0.5 with noise"


@pytest.mark.mitsuba
def test_another_start_is_told_on_the_terminal() -> None:
    """It decides which values a run returns, so the page is not enough."""
    from unrender.app.cli.execute import summarise
    from unrender.display.terminal import Console
    from unrender.runs.progress import Progress
    from unrender.runs.refinement import BEGUN_AGAIN

    problem = SimpleNamespace(views=[], unknowns={}, truth={}, parameter_error=lambda _: {})
    lines = [f"{BEGUN_AGAIN} 24 with other values of alpha", "numbers are means of their last steps: alpha 8"]
    result: Any = Result({}, {}, [], 1.0, 0.0, "steps", adapted=lines)
    text = io.StringIO()
    with Progress(Console(file=text, width=200)) as progress:
        summarise(Console(file=text, width=200), cast(Any, problem), result, progress)
    assert f"note: the run {lines[0]}" in text.getvalue()
    assert lines[1] not in text.getvalue()
