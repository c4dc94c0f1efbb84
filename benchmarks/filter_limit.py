"""`python -m benchmarks.filter_limit`: how much a film's filter costs on `poster` with a texel for each pixel, for any unbiased method.

An image is A T Aᵀ for a texture T, where A has the share of each texel in each pixel along one axis. Each pixel has samples of its own,
of equal variance. The least root mean square error of an unbiased estimate of T (Cramér and Rao) is then the noise of a pixel times
tr((AᵀA)⁻¹) / n. A box filter has A = 1. The ratio of the two limits is the best that a run can reach with a filter, relative to a box.
"""

from __future__ import annotations

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import mi
from unrender.gallery.poster import Poster

FILTERS = ("box", "gaussian", "tent", "mitchell", "catmullrom", "lanczos")
_SIDE, _FINE, _PICTURES = 32, 200, 48


def shares(values: np.ndarray, radius: float, side: int = _SIDE) -> np.ndarray:
    """Return A, (side, side), for texels as wide as pixels.

    Args:
        values: of the filter, evenly spaced over [-radius, radius].
        radius: of the filter, in pixels. It is cut off at the borders.
        side: number of pixels and of texels.
    """
    places = (np.arange(side * _FINE) + 0.5) / _FINE
    distances = places[None] - (np.arange(side) + 0.5)[:, None]
    weights = np.interp(distances, np.linspace(-radius, radius, len(values)), values, 0.0, 0.0)
    found = weights.reshape(side, side, _FINE).sum(axis=2)
    return found / found.sum(axis=1, keepdims=True)


def amplification(matrix: np.ndarray) -> float:
    """Return the factor of the least root mean square error over the noise of a pixel, tr((AᵀA)⁻¹) / n."""
    return float(np.trace(np.linalg.inv(matrix.T @ matrix)) / len(matrix))


def limits(filters: tuple[str, ...] = FILTERS, pictures: int = _PICTURES) -> dict[str, tuple[float, float, float]]:
    """Return {filter: (amplification, standard deviation of one sample over that with a box, limit of the error ratio)}."""
    poster, found, first = Poster(resolution=_SIDE, texture_resolution=_SIDE), {}, 0.0
    truth = ur.gallery.problem("poster", resolution=_SIDE, texture_resolution=_SIDE, reference_spp=1).truth
    for name in filters:
        scene = poster.scene()
        scene["camera"]["film"]["rfilter"] = {"type": name}
        blank = ur.View(np.zeros((_SIDE, _SIDE, 3), np.float32))
        problem = ur.Problem(scene, list(poster.parameters()), [blank], max_depth=poster.max_depth)
        images = np.stack([np.asarray(ur.render(problem, truth, 0, spp=1, seed=n)) for n in range(pictures)])
        deviation = float(np.sqrt(images.var(axis=0, ddof=1).mean()))
        first = first or deviation
        rfilter = mi.load_dict({"type": name})
        radius = float(rfilter.radius()) if name != "box" else 0.5
        values = np.array(rfilter.eval(mi.Float(np.linspace(-radius, radius, 4001).astype(np.float32))))
        factor = amplification(shares(values, radius)) if name != "box" else 1.0
        found[name] = factor, deviation / first, first / (deviation * factor)
    return found


def main() -> None:
    """Print the table."""
    ur.use()
    head = "filter | amplification | deviation of a sample over box | limit of error by box over error"
    print(markdown.table(head, ([name, *(f"{x:.2f}" for x in row)] for name, row in limits().items())))


if __name__ == "__main__":
    main()
