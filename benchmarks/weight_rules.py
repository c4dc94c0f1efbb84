"""Rules for the weight of a recursive control variate, on the same pairs of renders (RCV Fig. 3 and Sec. 7).

- plain: 0, each render alone;
- one: 1;
- analytic: n/(n+1), the weight of a mean of all renders;
- online: Eq. 8 with Var[F_CV] from running statistics of F_CV itself, as if consecutive images were independent;
- absolute: Eq. 8 with the recurrence (10) in absolute units, which keeps early, bad estimates of Var[F];
- relative: Eq. 8 with the recurrence relative to Var[F];
- greater: Eq. 8 with the greater of both variances where anything has moved: `unrender.images.RecursiveControlVariate` itself.

All but the first three estimate variances from earlier renders, from step 1 on, so that the first weight from
statistics is that of step 3. Until then the last has the weight of an average, the others 0, which is the paper's start.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import unrender as ur
from benchmarks.internals import Key, RenderSession, SampleRequest, Tree, advance, arrays, prepare
from benchmarks.paths import images_along
from unrender import statistics
from unrender.statistics import welford

SIMULATED = ("plain", "one", "analytic", "online", "absolute", "relative")
RULES = (*SIMULATED, "greater")


class Simulated:
    """A control variate in NumPy, by one of the rules.

    Args:
        rule: one of `SIMULATED`.
        first: the first render, (H, W, 3).
    """

    def __init__(self, rule: str, first: np.ndarray):
        self.rule, self.step, self.image = rule, 0, first
        self.current = self.previous = self.joint = welford.init(first)
        self.own = welford.update(welford.init(first), first, first)
        self.variance = np.zeros_like(first)
        self.relative = np.ones_like(first)

    def advance(self, F: np.ndarray, H: np.ndarray) -> np.ndarray:
        """Takes the next render and that of the state before, of the same samples; returns the weight that it used."""
        self.step += 1
        weight = self._weight(F)
        self.image = advance(self.image, F, H, weight)
        self.current, self.previous, self.joint = (
            welford.update(state, x, y)
            for state, x, y in ((self.current, F, F), (self.previous, H, H), (self.joint, F, H))
        )
        self.own = welford.update(self.own, self.image, self.image)
        of_f, of_h, cov = (welford.covariance(state) for state in (self.current, self.previous, self.joint))
        known = of_f > 0
        found = statistics.control_variate_variance(weight, of_f, of_h, cov, self.relative * of_h)
        averaged = weight * weight * self.relative + (1.0 - weight) ** 2
        self.variance = statistics.control_variate_variance(weight, of_f, of_h, cov, self.variance)
        self.relative = np.where(known, found / np.where(known, of_f, 1.0), averaged)
        return weight

    def _weight(self, F: np.ndarray) -> np.ndarray:
        if self.rule in ("plain", "one", "analytic"):
            of_all = {"plain": 0.0, "one": 1.0, "analytic": self.step / (self.step + 1)}
            return np.full_like(F, of_all[self.rule])
        of_h, cov = welford.covariance(self.previous), welford.covariance(self.joint)
        of_cv = {
            "online": lambda: welford.covariance(self.own),
            "absolute": lambda: self.variance,
            "relative": lambda: self.relative * of_h,
        }
        return statistics.control_weight(cov, of_h, of_cv[self.rule]())


def one_run(
    problem: ur.Problem, path: Sequence[Tree], spp: int, seed: int, rules: Sequence[str] = RULES
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Per rule, the images and the weights (0 at the first step), (steps, H, W, 3) each, all from the same samples."""
    session, sensor = prepare(problem, path[0], "path"), problem.views[0].sensor
    first, *pairs = _pairs(session, sensor, path, spp, seed)
    images, weights = {}, {}
    for rule in (rule for rule in rules if rule in SIMULATED):
        simulated = Simulated(rule, first[0])
        used, kept = [np.zeros_like(first[0])], [first[0]]
        for F, H in pairs:
            used.append(simulated.advance(F, H))
            kept.append(simulated.image)
        images[rule], weights[rule] = np.stack(kept), np.stack(used)
    if "greater" in rules:
        library = ur.images.RecursiveControlVariate()
        images["greater"], weights["greater"] = images_along(problem, library, path, spp, seed)
    return images, weights


def _pairs(
    session: RenderSession, sensor: int, path: Sequence[Tree], spp: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """F and H of each step; of the first one, F twice."""
    found = []
    for step, parameters in enumerate(path):
        request = SampleRequest(sensor, spp, Key(seed, step).uint32())
        pair = session.image_pair(parameters, path[max(step - 1, 0)], request, "path")
        F, H = (arrays.numpy(x)[0].astype(np.float64) for x in (pair.images, pair.previous))
        found.append((F, H))
    return found
