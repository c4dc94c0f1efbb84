"""The start of an exponentially weighted mean (RCV Fig. 12): a mean that begins with weight 1 on its first value forgets it slowly.

Sequences of independent normal variates. "first kept" is the mean m ← α m + (1 − α) x that begins with m = x₀ (Eq. 19); "corrected" divides
by the sum of its weights, 1 − α^(n+1) (Eq. 18), as `unrender.statistics.welford` does. Both are unbiased. Compared are the
mean squares over sequences with what the weights say in closed form, the weight that the first value has, and after how many values
it weighs at most 1 − α, which is what the newest one weighs in the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record
from unrender.statistics import welford

RENDERS = False
ALPHAS = (0.9, 0.99, 0.999)
"""Decays."""
QUICK = {"values": 20, "sequences": 200}


def first_kept(alpha: float, count: int) -> np.ndarray:
    """The weights of x₀, ..., x_{count-1} in the mean that begins with its first value: Eq. 19."""
    return np.append(alpha ** (count - 1.0), (1 - alpha) * alpha ** np.arange(count - 2.0, -1, -1))


def corrected(alpha: float, count: int) -> np.ndarray:
    """The same in the mean divided by the sum of its weights: Eqs 17 and 18."""
    return (1 - alpha) * alpha ** np.arange(count - 1.0, -1, -1) / (1 - alpha**count)


WEIGHTS = {"first kept": first_kept, "corrected": corrected}


def means(x: np.ndarray, alpha: float) -> dict[str, np.ndarray]:
    """Both means after each value of sequences (sequences, values)."""
    state, kept = welford.init(x[:, 0]), x[:, 0]
    found: dict[str, list[np.ndarray]] = {name: [] for name in WEIGHTS}
    for number, value in enumerate(x.T):
        state = welford.update(state, value, value, alpha=alpha)
        kept = value if number == 0 else alpha * kept + (1 - alpha) * value
        found["first kept"].append(kept)
        found["corrected"].append(np.asarray(state.mean_x))
    return {name: np.stack(each, axis=1) for name, each in found.items()}


def forgotten_after(alpha: float, name: str) -> int:
    """How many values there are when the first one weighs at most 1 − α, which is what the newest weighs in the end."""
    count = 1
    while WEIGHTS[name](alpha, count)[0] > 1 - alpha:
        count += 1
    return count


def run(values: int = 200, sequences: int = 4000) -> dict[str, Any]:
    """Every decay, on the same sequences.

    Args:
        values: of a sequence
    """
    x = np.random.default_rng(0).normal(size=(sequences, values))
    decays: dict[str, Any] = {}
    for alpha in ALPHAS:
        entry: dict[str, Any] = {}
        for name, found in means(x, alpha).items():
            weights = [WEIGHTS[name](alpha, n) for n in range(1, values + 1)]
            squares = np.square(found)
            entry[name] = {
                "first_weight": [float(each[0]) for each in weights],
                "mean_square": squares.mean(axis=0).tolist(),
                "standard_error": (squares.std(axis=0, ddof=1) / np.sqrt(sequences)).tolist(),
                "closed_form": [float(np.square(each).sum()) for each in weights],
                "forgotten_after": forgotten_after(alpha, name),
            }
        decays[f"{alpha:g}"] = entry
    return {"decays": decays}


def table(record: Record) -> str:
    """Weights of the first value, and mean squares."""
    rows = []
    for found in markdown.named(record["decays"], "alpha", "", "name"):
        columns = (found[key] for key in ("mean_square", "closed_form", "standard_error"))
        worst = max(abs(m - c) / e for m, c, e in zip(*columns, strict=True))
        places = [n for n in (10, 50, 200) if n <= len(found["closed_form"])]
        weights = " / ".join(f"{found['first_weight'][n - 1]:.2g}" for n in places)
        squares = " / ".join(f"{found['mean_square'][n - 1]:.3f}" for n in places)
        rows.append([found["alpha"], found["name"], weights, squares, f"{worst:.1f}", found["forgotten_after"]])
    head = "α | mean | weight of the first value after 10 / 50 / 200 | mean square | largest z against the closed form"
    head += " | values until the first weighs 1 − α or less"
    text = "{sequences} sequences of normal variates."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))
