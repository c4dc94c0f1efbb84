"""Derivatives of pixels and predicted deviations on a fixed path of parameters (Meta Figs 3 and 4).

On `indirect-room`, without an optimizer, so that nothing feeds back: the left wall's blue and those of floor and ceiling go from
start to end in equal steps (Fig. 3), or by steps that halve their distance (Fig. 4). Forward derivatives of all pixels by the wall's
blue are taken from one sample per pixel and step, for all runs at once. Adam's mean (decay 0.9), which sees the proportional samples
alone, stands beside the paper's meta-estimate, with α from its own samples and from those of another run. Deviations that single
runs predict, their variances and their α are compared with the actual ones and the best α.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, RenderSession, SampleRequest, arrays, prepare
from benchmarks.runner.records import Record
from unrender.statistics import meta

COLOUR = "left.bsdf.reflectance.value"
MOVED = {
    COLOUR: (0.06, 0.8),
    "floor.bsdf.reflectance.value": (0.75, 0.35),
    "ceiling.bsdf.reflectance.value": (0.75, 0.35),
}
"""The blue reflectances that change along the path, from and to."""
BLUE, WIDTH = 2, 0.02
DEPTH = 5
"""Longest paths, below the depth of Russian roulette: on equal random numbers an image is then a polynomial of the reflectances."""
DEGREE = 6
HALF_LIFE = 8.0
QUICK = {"runs": 20, "steps": 30, "resolution": 4}
SETTLED = 10
"""Steps that a memory has before its prediction is judged."""
METHODS = ("adam", "meta", "independent")
"""Adam's mean; the paper's estimate, with α from its own samples, and from those of another run."""
BETA_1, BETA_2 = 0.9, 0.999


def shares(name: str, steps: int) -> np.ndarray:
    """(steps,) shares of the way: "linear", or "decaying" by halves."""
    return np.linspace(0, 1, steps) if name == "linear" else 1 - 0.5 ** (np.arange(steps) / HALF_LIFE)


class Derivatives:
    """Forward derivatives of all pixels by the wall's blue, one sample per pixel and run; blue channel alone."""

    def __init__(self, resolution: int, runs: int):
        self.problem = ur.gallery.problem(
            "indirect-room", resolution=resolution, texture_resolution=8, reference_spp=16, max_depth=DEPTH
        )
        self.runs, self.start = runs, self.problem.renderer.values(list(MOVED))
        self.session: RenderSession = prepare(self.problem, self.start)

    def image(self, share: float, offset: float, seed: int) -> np.ndarray:
        """(runs, pixels) of the scene at a share of the way, the wall's blue off by `offset`."""
        parameters = {}
        for key, (first, last) in MOVED.items():
            value = np.array(arrays.numpy(self.start[key]), np.float32)
            value[BLUE] = first + share * (last - first) + (offset if key == COLOUR else 0.0)
            parameters[key] = self.problem.renderer.array(value)
        request = SampleRequest(self.problem.views[0].sensor, self.runs, Key(5, seed).uint32(), self.runs)
        found = arrays.numpy(self.session.image(parameters, request).images)
        return found[..., BLUE].reshape(self.runs, -1).astype(np.float64)

    def __call__(self, share: float, seed: int) -> np.ndarray:
        """(runs, pixels): a central difference on equal random numbers."""
        return (self.image(share, WIDTH, seed) - self.image(share, -WIDTH, seed)) / (2 * WIDTH)


def along(derivatives: Derivatives, path: np.ndarray) -> dict[str, Any]:
    """The samples and the estimates at each step, (steps, runs, pixels) each, in single precision."""
    length = np.sqrt(sum((last - first) ** 2 for first, last in MOVED.values()))
    steps, kept = len(path), {}
    first = second = np.zeros(1)
    state: Any = None
    other: Any = None

    def keep(index: int, **values: np.ndarray) -> None:
        for name, value in values.items():
            kept.setdefault(name, np.zeros((steps, *value.shape), np.float32))[index] = value

    for i, share in enumerate(path):
        F = derivatives(share, 2 * i)
        if state is None:
            state, other, change = meta.init(F), meta.init(F), 0.0 * F
        else:
            change = derivatives(share, 2 * i + 1) - derivatives(path[i - 1], 2 * i + 1)
        moved = float(length * abs(share - path[max(i - 1, 0)]))
        gradient, variance, alpha, state = meta.update(state, F, change, moved)
        observed = np.roll(F, 1, axis=0), np.roll(change, 1, axis=0)  # another run's
        independent, its_variance, _, other = meta.update(other, F, change, moved, observed=observed)
        var_f = state.proportional.square / state.proportional.weight
        var_d = state.difference.square / max(float(state.difference.weight), 1e-30) * moved**2
        first, second = BETA_1 * first + (1 - BETA_1) * F, BETA_2 * second + (1 - BETA_2) * F * F
        weight = 1 - BETA_1 ** (i + 1)
        shrink = (1 - BETA_1) / (1 + BETA_1) * (1 + BETA_1 ** (i + 1)) / weight
        adam_variance = second / (1 - BETA_2 ** (i + 1)) * shrink
        keep(i, F=F, change=change, meta=gradient, meta_variance=variance, alpha=alpha, var_f=var_f, var_d=var_d)
        keep(i, independent=independent, independent_variance=its_variance)
        keep(i, adam=first / weight, adam_variance=adam_variance)
    return kept


def lag(mean: np.ndarray, truth: np.ndarray, window: slice) -> float:
    """By how many steps the mean estimate trails the truth, over pixels and a window of steps: least squares."""
    slope = np.gradient(truth, axis=0)[window]
    return float(np.sum((truth - mean)[window] * slope) / np.sum(slope**2))


def measure(derivatives: Derivatives, name: str, steps: int) -> dict[str, Any]:
    """One path: errors, lag and predicted over actual deviations over all pixels, and three pixels in full."""
    path = shares(name, steps)
    kept = along(derivatives, path)
    mean_f, mean_d = kept["F"].mean(1, dtype=np.float64), kept["change"].mean(1, dtype=np.float64)
    powers = np.polynomial.polynomial.polyvander(path, DEGREE)
    truth = powers @ np.linalg.lstsq(powers, mean_f, rcond=None)[0]
    actual = {k: kept[k].std(1, ddof=1, dtype=np.float64) for k in ("F", "change", *METHODS)}
    order = np.argsort(actual["F"].mean(0))
    pixels = [int(order[-1]), int(order[int(0.75 * len(order))]), int(order[len(order) // 2])]
    window = slice(2 * SETTLED, steps) if name == "linear" else slice(2, max(4, round(3 * HALF_LIFE)))
    found: dict[str, Any] = {"pixels": pixels, "truth": truth[:, pixels].tolist(), "methods": {}}
    plain = np.sqrt(np.mean((kept["F"] - truth[:, None]) ** 2, axis=(1, 2)))
    for method in METHODS:
        predicted = np.sqrt(kept[f"{method}_variance"].astype(np.float64))
        ratio = predicted[SETTLED:] / actual[method][SETTLED:, None]
        of_rms = np.sqrt(np.mean(predicted[SETTLED:] ** 2, axis=1)) / actual[method][SETTLED:]
        error = np.sqrt(np.mean((kept[method] - truth[:, None]) ** 2, axis=(1, 2)))
        found["methods"][method] = {
            "error": (error / plain).tolist(),
            "variance_over_plain": [float(np.mean(actual[method][n] ** 2) / np.mean(actual["F"][n] ** 2))
                                    for n in (steps // 2, steps - 1)],
            "lag": lag(kept[method].mean(1, dtype=np.float64), truth, window),
            "predicted_over_actual": [float(q) for q in np.quantile(of_rms, [0.05, 0.25, 0.5, 0.75, 0.95])],
            "within_half_to_two": float(np.mean((ratio > 0.5) & (ratio < 2.0))),
            "run": kept[method][:, 0][:, pixels].tolist(),
            "run_predicted": predicted[:, 0][:, pixels].tolist(),
        }  # fmt: skip
    # Rows 3 to 5 of Fig. 4: variances over the runs beside the estimates of single runs, and α beside the best one.
    best = np.zeros_like(actual["F"])
    variance = actual["F"][0] ** 2
    for i in range(1, steps):
        f, d = actual["F"][i] ** 2, actual["change"][i] ** 2
        best[i] = f / (f + variance + d)
        variance = best[i] ** 2 * (variance + d) + (1 - best[i]) ** 2 * f
    late = slice(SETTLED, steps)
    for key, real in (("var_f", actual["F"] ** 2), ("var_d", actual["change"] ** 2)):
        thought = kept[key].mean(1, dtype=np.float64)
        found[f"{key}_over_actual"] = float(np.median(thought[late] / np.maximum(real[late], 1e-30)))
    off = (kept["alpha"][late] - best[late, None]).astype(np.float64)
    found["alpha_below_best"] = float(np.mean(off < 0))
    found["alpha_off"] = [float(q) for q in np.quantile(off, [0.05, 0.5, 0.95])]
    found["change_mean_error"] = float(np.sqrt(np.mean((mean_d[1:] - np.diff(truth, axis=0)) ** 2)))
    print(name, {m: (f["error"][-1], f["lag"], f["predicted_over_actual"][2], f["within_half_to_two"])
                 for m, f in found["methods"].items()}, found["alpha_off"], flush=True)  # fmt: skip
    return found


def run(runs: int = 400, steps: int = 100, resolution: int = 12) -> dict[str, Any]:
    """Both paths.

    Args:
        runs: rendered at once
    """
    derivatives = Derivatives(resolution, runs)
    return {"paths": {name: measure(derivatives, name, steps) for name in ("linear", "decaying")}}


def table(record: Record) -> str:
    names = {"adam": "Adam's mean", "meta": "meta", "independent": "meta, independent statistics"}
    row = "{error[half]:.3f} | {error[-1]:.3f} | {variance_over_plain[0]:.3f} | {variance_over_plain[1]:.3f} | {lag:.2f} | "
    row += "{predicted_over_actual[2]:.2f} | {predicted_over_actual[0]:.2f} to {predicted_over_actual[4]:.2f} | {within:.0f} %"
    rows, others = [], []
    for path, entry in record["paths"].items():
        for method, f in entry["methods"].items():
            half = row.replace("half", str(len(f["error"]) // 2))
            rows.append([path, names[method], markdown.fill(half, f, {"within": 100 * f["within_half_to_two"]})])
        other = "{var_f_over_actual:.2f} | {var_d_over_actual:.2f} | {alpha_off[1]:+.3f} ({alpha_off[0]:+.3f} to {alpha_off[2]:+.3f})"
        others.append([path, markdown.fill(other, entry), f"{100 * entry['alpha_below_best']:.0f} %"])
    text = "Forward derivatives of pixels by the left wall's blue, {resolution}², one sample per pixel and step, "
    text += "{steps} steps, {runs} runs; errors and variances over those of one sample:"
    head = "path | estimate | RMSE, half way | at the end | variance, half way | at the end | lag, steps | predicted / actual deviation"
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.table(f"{head} | 5 % to 95 % of pixels and steps | single predictions within 0.5 to 2", rows),
        "Variances that single runs estimate over the actual ones, medians, and α less the best one:",
        markdown.table("path | Var F | Var ΔF | α off: median (5 % to 95 %) | α below the best", others),
    )


def plot(record: Record) -> figures.Figure:
    """Error over all pixels, and the estimates of the median pixel with the deviation that one run predicts."""
    panels = {}
    for path, found in record["paths"].items():
        methods = found["methods"]
        panels[f"{path}: RMSE / one sample's"] = {name: figures.over_steps(f["error"]) for name, f in methods.items()}
        truth = np.array(found["truth"])[:, 2]
        panels[f"{path}: median pixel, derivative by blue"] = {"true": figures.over_steps(truth)}
        for name in ("adam", "meta"):
            run, known = (np.array(methods[name][key])[:, 2] for key in ("run", "run_predicted"))
            panels[f"{path}: median pixel, derivative by blue"][name] = figures.band(range(len(run)), run, known)
    return figures.curves(panels, "step", "", columns=2, log="")
