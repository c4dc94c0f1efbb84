"""Differences along numbers that are short enough, and directions of textures and grids whose changes of the pictures approximate those of
numbers, by adjoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from unrender.core import timing
from unrender.core.random import Key
from unrender.rendering.renderer import RenderSession
from unrender.runs.image_sensitivity import MAP_AXES, adjoint_spp, adjoints, around, derivative_session
from unrender.runs.numbers import Differences, Numbers
from unrender.scene.bounds import off_ends
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree

_MOST_VALUES = 1 << 25
"""Values of all states of textures and grids up to which they are tested."""
_PATHS, _MOST_LAUNCHES = 1 << 16, 4
"""Path budget and most launches of one direction."""
_ROUNDS, _FIRST, _CHANGE = 8, 0.25, 64.0
"""Most rounds of directions; the first factor of a direction, and by how much it may fall."""
_INDEPENDENT = 1e-3
"""Eigenvalue relative to the largest below which a direction changes the pictures as the others do."""
_SHRINKS = 0.9
"""Ratio of a number's squared remainder to that of the round before, up to which there is another round."""
_WEAKEST = 1e-4  # smallest eigenvalue, relative to the largest, that the length of a direction follows
_RIDGE = 0.3
"""Sensitivity relative to the median below which cells hardly take part."""
_SHORTENED, _NARROW, _CURVED, _CURVED_ERRORS = 3, 0.25, 0.5, 3.0
"""Most rounds of shorter differences, and their ratio; relative change of slopes, and errors beyond it, from which they are too long."""
_LATE, _UNRESOLVED = "the run is too short for this test", "whose share in the pictures is not resolved"
"""Reasons of a missing standard error: the directions found so far do not contain all that trades off against a number."""


def independent(differences: Differences, limits: np.ndarray, change: float) -> tuple[np.ndarray, float]:
    """Return factors (K, K) of directions whose sums change pictures independently, within limits (n,), and the least eigenvalue."""
    matrix, (_, errors) = differences.matrix(), differences.squares()
    units = np.sqrt(np.maximum(np.maximum(np.diag(matrix), errors), 1e-12 * np.abs(matrix).max() or 1.0))
    eigenvalues, vectors = np.linalg.eigh(matrix / np.outer(units, units))
    least = max(_WEAKEST * eigenvalues.max(), 1e-30)  # noise may leave no positive one
    lengths = change * np.sqrt(differences.one[0].size / np.maximum(eigenvalues, least))
    factors = vectors * lengths / units[:, None]
    longer = np.maximum(np.max(np.abs(differences.directions @ factors) / limits[:, None], axis=0), 1.0)
    return factors / longer, float(eigenvalues[0])


def narrowed(
    numbers: Numbers, differences: Differences, key: Key, until: float
) -> tuple[Differences, np.ndarray | float]:
    """Return differences along each number with which pictures change in proportion, beyond noise, and limits of these, (n,).

    Long ones reach other parts of the loss, such as where a sun lights another face. Their slopes then tell the distance from the solution,
    and its error, in a wrong scale. They are not shortened where distance or error would be longer than they are.
    """
    residual, short = numbers.residual(numbers.point, key), np.zeros(numbers.count, bool)
    for index in range(_SHORTENED):
        if timing.now() > until:
            break
        narrow = numbers.differences(_NARROW * differences.directions, key.fold(index))
        lengths, own = np.diag(differences.directions), np.diag(narrow.directions)  # bounds may cut them
        ratio = np.divide(own, lengths, out=np.ones_like(own), where=(own > 0.0) & (lengths > 0.0))[:, None, None]
        halves = ((differences.one, narrow.one), (differences.other, narrow.other))
        squares, errors = Differences(narrow.directions, *(b / ratio - a for a, b in halves)).squares()
        along = (narrow.average() * residual).sum(axis=2)
        far = np.hypot(along.sum(axis=1), np.sqrt(np.square(along).sum(axis=1)))
        curved = squares > _CURVED**2 * np.maximum(differences.squares()[0], 0.0) + _CURVED_ERRORS * errors
        curved &= far * ratio[:, 0, 0] < narrow.squares()[0]
        if not curved.any():
            break
        directions, short = np.where(curved, narrow.directions, differences.directions), short | curved
        differences = replace(differences.moved(narrow, 1.0 * curved), directions=directions)
    return differences, np.where(short, np.diag(differences.directions), np.inf)


def fields_of(numbers: Numbers, sensitivities: Mapping[str, np.ndarray]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the keys of unknown textures, grids and lists that can move, and {key: reason} of all other unknowns, which stay fixed.

    Unknowns that change none of the rendered pictures are in neither.
    """
    infos, problem = numbers.problem.renderer.parameters(), numbers.problem
    sensors = {problem.views[view].sensor for view in numbers.views}
    moved, fixed = [], {}
    for key in numbers.values:
        info, seen = infos[key], sensitivities.get(key)
        if key in numbers.keys or not (info.sensor is None or info.sensor in sensors):
            continue
        if info.welded:
            fixed[key] = "which is a mesh"
        elif seen is not None and not seen.any():
            continue
        elif problem.unknowns[key].prior is not None:
            fixed[key] = "which has a prior"
        elif seen is None or not info.perturbable:
            fixed[key] = "which has no derivative"
        else:
            moved.append(key)
    states = 2 * _ROUNDS * (1 + numbers.count) + 2 * len(moved)
    if states * sum(sensitivities[key].size for key in moved) > _MOST_VALUES:
        return (), fixed | dict.fromkeys(moved, "which is too large")
    return tuple(moved), fixed


def add_field_directions(
    numbers: Numbers,
    differences: Differences,
    keys: Sequence[str],
    sensitivities: Mapping[str, np.ndarray],
    change: float,
    key: Key,
    until: float,
) -> tuple[Numbers, Differences, str] | None:
    """Return numbers with directions of textures and grids that trade off against them, the differences along both, and a reason.

    The reason says why directions are missing, so that standard errors would be too small; "" if none are. The result is None if the
    time is over before the first directions.

    The first directions are each texture's and grid's own values, which trade off exactly against a factor of them, such as the scale of
    an environment map. The next ones approximate, by one adjoint, the picture changes of the numbers and of the residual, and then the
    remainder.

    Args:
        keys: keys of the textures and grids, see `fields_of`; at least one.
        sensitivities: see `unrender.sensitivity`.
        change: root mean square of a difference.
        until: time after which nothing is started.
    """
    adjoints = _Adjoints(numbers, keys, sensitivities, key)
    active, squares = np.arange(numbers.count), differences.squares()[0]
    residual = numbers.pictures(numbers.point[None], key.fold(2)) - numbers.references()
    targets, made = np.concatenate([differences.average(), residual]), numbers
    parts: list[Differences] = []
    longest = 0.0
    for index in range(_ROUNDS):
        started = timing.now()
        if not len(targets) or started + longest > until:
            break
        directions = adjoints.of(targets)
        if index == 0:
            directions = {k: np.concatenate([x, directions[k]]) for k, x in adjoints.scaled().items()}
        before_these, made = len(made.point), made.with_directions(directions)
        columns = np.eye(len(made.point))[:, before_these:]
        first = made.differences(_FIRST * columns, key.fold(3 + 2 * index))
        changes = np.sqrt(np.maximum(*first.squares()) / first.one[0].size)
        factors = np.clip(change / np.maximum(changes, 1e-30), 1.0 / _CHANGE, 1.0 / _FIRST)
        last = made.differences(_FIRST * columns * factors, key.fold(4 + 2 * index))
        parts = [_longer(one, len(made.point)) for one in (*parts, last)]
        remainder = _remainder(differences, _joined(parts))
        before, squares = squares, remainder.squares()[0]
        active = active[squares[active] < _SHRINKS * before[active]]
        targets = remainder.average()[active]
        longest = max(longest, timing.now() - started)
    if not parts:
        return None
    missing = "" if not len(targets) else _UNRESOLVED if len(parts) == _ROUNDS else _LATE
    if (independent := _independent(made, differences, _joined(parts), len(keys))) is None:
        return numbers, differences, _UNRESOLVED
    return *independent, missing


def _longer(differences: Differences, rows: int) -> Differences:
    """Return the differences with zeros for further factors."""
    missing = rows - len(differences.directions)
    directions = np.pad(differences.directions, ((0, missing), (0, 0)))
    return Differences(directions, differences.one, differences.other)


def _joined(parts: Sequence[Differences]) -> Differences:
    directions = np.concatenate([part.directions for part in parts], axis=1)
    one, other = (np.concatenate([getattr(part, half) for part in parts]) for half in ("one", "other"))
    return Differences(directions, one, other)


def _remainder(numbers: Differences, of: Differences) -> Differences:
    """Return the numbers' differences less what a sum of the others explains."""
    halves = [x.reshape(len(x), -1) for x in (of.one, of.other, numbers.one, numbers.other)]
    products = 0.5 * (halves[0] @ halves[3].T + halves[1] @ halves[2].T)
    factors = (np.linalg.pinv(of.matrix(), rcond=_INDEPENDENT, hermitian=True) @ products).T
    one, other = (x - np.tensordot(factors, y, axes=1) for x, y in ((numbers.one, of.one), (numbers.other, of.other)))
    return Differences(numbers.directions, one, other)


def _sums(matrix: np.ndarray, first: int) -> np.ndarray | None:
    """Return sums (K, k) of K directions that change the pictures independently, from products (K, K) of the changes; None for none.

    The `first` ones are combined among themselves only, since sums with others would not trade off exactly.
    """
    if not np.isfinite(matrix).all():
        return None
    least, parts = _INDEPENDENT * float(np.linalg.eigvalsh(matrix)[-1]), []
    among = np.linalg.pinv(matrix[:first, :first], rcond=_INDEPENDENT, hermitian=True) @ matrix[:first, first:]
    own, others = np.eye(len(matrix))[:, :first], np.eye(len(matrix))[:, first:]
    for basis in (own, others - own @ among):
        eigenvalues, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
        used = eigenvalues > max(least, 0.0)
        parts.append(basis @ vectors[:, used] * np.sqrt(matrix.trace() / len(matrix) / eigenvalues[used]))
    sums = np.concatenate(parts, axis=1)
    return sums if sums.size else None


def _independent(
    numbers: Numbers, differences: Differences, of_fields: Differences, first: int
) -> tuple[Numbers, Differences] | None:
    """Return the numbers with those sums of directions that change the pictures independently, and all differences."""
    if (sums := _sums(of_fields.matrix(), first)) is None:
        return None
    factors = (of_fields.directions @ sums)[numbers.count :]
    longest = np.maximum(np.abs(factors).max(axis=0), 1.0)
    fields = {key: np.tensordot((factors / longest).T, x, axes=1) for key, x in numbers.fields.items()}
    alone = numbers.alone()
    count = sums.shape[1]
    made, one, other = (
        alone.with_directions(fields),
        *(np.tensordot((sums / longest).T, x, axes=1) for x in (of_fields.one, of_fields.other)),
    )
    own = np.zeros((len(made.point), count))
    own[alone.count :] = np.eye(count)
    return made, _joined([_longer(differences, len(made.point)), Differences(own, one, other)])


class _Adjoints:
    """Approximate solutions w of J w = d, with the derivative J of the pictures by textures and grids.

    They are Jᵀ d divided by the diagonal of JᵀJ, the first iterate of Jacobi's method.
    """

    def __init__(self, numbers: Numbers, keys: Sequence[str], sensitivities: Mapping[str, np.ndarray], key: Key):
        self._numbers, self._problem, self._key = numbers, numbers.problem, key
        self._diagonals = {k: _diagonal(sensitivities[k]) for k in keys}
        self._reach = {k: _reach(self._problem, k, numbers.values[k]) for k in keys}
        tree = as_tree(self._problem, numbers.values)
        self._tree = off_ends(tree, self._problem.renderer.parameters())
        session, _ = derivative_session(self._problem)  # that of the sensitivities, whose kernels are compiled
        assert session is not None
        self._session: RenderSession = session
        pixels = sum(height * width for height, width in (self._problem.sizes[view] for view in numbers.views))
        self._spp = adjoint_spp(self._problem)
        self._launches = min(max(_PATHS // (self._spp * pixels), 1), _MOST_LAUNCHES)

    def of(self, pictures: np.ndarray) -> dict[str, np.ndarray]:
        """Return {key: (k, *shape)} for pictures (k, P, 3) with the roots of the pixels' weights. Their largest change is that allowed."""
        views, problem = self._numbers.views, self._problem
        roots = np.concatenate([self._numbers.roots(view) for view in views])
        weighted = self._numbers.by_view(pictures * roots)
        parts = []
        for launch in range(self._launches):
            seeds = {view: self._key.fold(launch).fold(view) for view in views}
            parts.append(adjoints(problem, self._session, self._tree, self._diagonals, self._spp, seeds, weighted))
        directions = {key: sum(part[key] for part in parts) / x for key, x in self._diagonals.items()}
        lengths = [np.abs(x).reshape(len(x), -1).max(axis=1) / self._reach[key] for key, x in directions.items()]
        longest = np.maximum(np.max(lengths, axis=0), 1e-300)
        return {key: x / longest.reshape(-1, *(1,) * (x.ndim - 1)) for key, x in directions.items()}

    def scaled(self) -> dict[str, np.ndarray]:
        """Return {key: (k, *shape)}: for each of the k textures and grids its own values, scaled so that their largest is that allowed."""
        values = {key: np.asarray(self._numbers.values[key], np.float64) for key in self._reach}
        scales = [self._reach[key] / max(float(np.abs(x).max()), 1e-300) for key, x in values.items()]
        return {
            key: np.stack([scale * x * (key == of) for of, scale in zip(values, scales, strict=True)])
            for key, x in values.items()
        }


def _diagonal(sensitivity: np.ndarray) -> np.ndarray:
    """Return the smoothed squares of a sensitivity, without cells that are hardly seen."""
    own = around(sensitivity)[..., None] if sensitivity.ndim >= MAP_AXES else np.abs(sensitivity)
    squares = np.square(own, dtype=np.float64)
    seen = squares[squares > 0.0]
    return np.broadcast_to(squares + (_RIDGE**2 * np.median(seen) if seen.size else 1.0), sensitivity.shape)


def _reach(problem: Problem, key: str, values: np.ndarray) -> float:
    """Return the largest change of an element: half the largest value, or a quarter of the range."""
    low, high = problem.unknowns[key].bounds
    if low is not None and high is not None:
        return 0.25 * (high - low)
    return 0.5 * (float(np.abs(values).max()) or 1.0)
