"""Ablations of meta-estimation (Meta Fig. 5): `ajar`, one part left out at a time, each tuned.

Left out: the zero-centred moments (variances about the mean instead), the bound of alpha, the shared samples
(statistics from independent ones, at twice the cost), the decoupling of the difference's variance from the step. Both
forms.
"""

from __future__ import annotations

from typing import Any

import unrender as ur
from benchmarks.races import Entrant, race

RATES = (0.0003, 0.001)
ABLATIONS: dict[str, dict[str, Any]] = {
    "whole": {},
    "centred variances": {"centred": True},
    "alpha not bounded": {"clip": False},
    "independent statistics": {"statistics": "independent"},
    "not decoupled": {"decouple": False},
}
FORMS = {"meta": {}, "coupled": {"coupled": True, "spp": 3}}
QUICK = {"seconds": 0.1, "seeds": 2, "resolution": 8}


def entrants() -> list[Entrant]:
    """Both forms, whole and with each part left out."""
    return [
        Entrant(f"{form}, {name}", name, ur.MetaEstimator(**kind, **options), ur.optimizers.MetaAdam, RATES)
        for form, kind in FORMS.items()
        for name, options in ABLATIONS.items()
    ]


def run(seconds: float = 5.0, seeds: int = 2, resolution: int = 48) -> dict[str, Any]:
    """The race of all forms.

    Args:
        seconds: budget of every run
    """
    return {"methods": race(ur.gallery.problem("ajar", resolution=resolution), entrants(), seeds, seconds=seconds)}
