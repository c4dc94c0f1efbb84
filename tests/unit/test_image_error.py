"""The error of pictures that `unrender run` tells, where their noise is not known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest


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
    assert image_error(result, masks=[mask, mask]) == "0.5 with noise"
    assert image_error(result, masks=[mask, None]) != "0.5 with noise"
    assert image_error(result) == image_error(result, masks=[None, None]) != "0.5 with noise"
    assert image_error(result, masks=[0 * mask, mask]).endswith("with noise")
    result.problem["views"] = 4  # of large problems some views alone have final pictures
    assert image_error(result, masks=[mask] * 4) == "0.5 with noise"
