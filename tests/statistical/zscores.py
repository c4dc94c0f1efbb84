"""Are two sets of noisy images estimates of the same image? Tests with measured standard errors, corrected for their number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from unrender.rendering.renderer import SampleRequest


def blocks(images: np.ndarray, size: int) -> np.ndarray:
    """(runs, H, W, C) -> (runs, H/size, W/size, C), means over blocks of pixels."""
    runs, height, width, channels = images.shape
    return images.reshape(runs, height // size, size, width // size, size, channels).mean(axis=(2, 4))


def z_scores(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Welch's statistic per element of two sets (runs, ...) of independent images, turned into standard normal scores."""
    na, nb = len(a), len(b)
    va, vb = a.var(axis=0, ddof=1) / na, b.var(axis=0, ddof=1) / nb
    total = va + vb
    difference = a.mean(axis=0) - b.mean(axis=0)
    known = total > 1e-20
    assert np.all(np.abs(difference[~known]) < 1e-6), "pixels without noise differ"
    t = difference[known] / np.sqrt(total[known])
    freedom = total[known] ** 2 / (va[known] ** 2 / (na - 1) + vb[known] ** 2 / (nb - 1))
    return np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), freedom).clip(1e-300))


@dataclass(frozen=True)
class Agreement:
    """A verdict, which is its truth value, and the figures that a failed assertion shows."""

    verdict: bool
    figures: str

    def __bool__(self) -> bool:
        return self.verdict


def check_pair(session: Any, current: Any, previous: Any, runs: int, spp: int, fault: float | None = None) -> None:
    """Both images of a pair on shared paths agree with separate ones; times `fault` they do not."""
    pair = session.image_pair(current, previous, SampleRequest(0, runs * spp, 1, runs), "path")
    for state, images, seed in ((current, pair.images, 2), (previous, pair.previous, 3)):
        alone = session.image(state, SampleRequest(0, runs * spp, seed, runs)).images
        both, single = (np.stack([np.array(image, np.float64) for image in of]) for of in (images, alone))
        assert agree(both, single)
        assert fault is None or not agree(fault * both, single), f"a factor of {fault} went unseen"


def agree(a: np.ndarray, b: np.ndarray, size: int = 8, level: float = 1e-3) -> Agreement:
    """Whether two sets (runs, H, W, 3) of independent images agree: as a whole and per block, at `level` after Šidák."""
    worst, count = 0.0, 0
    whole = np.abs(z_scores(a.mean(axis=(1, 2, 3))[:, None], b.mean(axis=(1, 2, 3))[:, None])).max()
    parts = np.abs(z_scores(blocks(a, size), blocks(b, size)))
    worst, count = float(parts.max()), parts.size
    limit_parts = stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2)
    limit_whole = stats.norm.isf(level / 2)
    figures = f"whole |z| {whole:.2f} (limit {limit_whole:.2f}), worst of {count} blocks {worst:.2f} (limit {limit_parts:.2f})"
    return Agreement(bool(whole < limit_whole and worst < limit_parts), figures)
