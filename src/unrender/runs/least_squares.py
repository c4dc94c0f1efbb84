"""Least squares at the end of a run: which of a few numbers the references do not determine, and which had not arrived."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from unrender.core import timing
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.core.text import listed
from unrender.display import formatting
from unrender.runs.field_directions import add_field_directions, fields_of, independent, narrowed
from unrender.runs.image_sensitivity import shown_elsewhere
from unrender.runs.numbers import ERRORS, Differences, Numbers, NumbersCheck
from unrender.runs.reference_distortions import distortions_of_fit
from unrender.runs.verification import SMOOTH, compares, unexplained_share
from unrender.scene.problem import Problem
from unrender.statistics import scores

_STREAM, _FIELDS, _SHORT = 4, 1 << 16, 1 << 17
"""Stream of all random numbers, and indices of those of textures and grids, and of short differences."""
_PASSES, _REPEATS, _CHANGES = 3, 8, (64.0, 8.0, 4.0)
"""Passes that find widths, most repeats of the pictures that are judged, and the factors by which widths change at most."""
_FIRST_WIDTH, _SHIFT = 0.02, 0.3
"""First widths of differences, relative to their limits; shift of the picture, in pixels, that a difference is as large as."""
_FLAT, _COMPARABLE = 0.1, 0.3
"""Change of the pictures relative to that of a shift by `_SHIFT` below which the longest difference leaves a number undetermined;
noise of the references relative to that of this check from which a change that the check does not see is undetermined."""
_CHANNELS = 3.0  # channels that share their noise
_DOUBTFUL = 0.1  # standard error, as a share of a number's size, from which on it is undetermined
_FURTHER, _STEP_ERRORS = 0.05, 4.0  # least step reported: share of a number's size, standard errors
_OF_WIDTHS, _TOGETHER = 10.0, 0.9
"""Size of a pose, in widths of its differences; correlation from which on two numbers count as determined together."""
_ROUNDS, _WEAK = 3, 0.1  # most rounds that measure weak directions again, and their largest eigenvalue
_DISTORTED = 2.0  # standard errors by which a distortion of the references must move a number that has none then
_FAR, _BETTER, _NOISY = 6.0, 1.0, 0.05
"""Standard errors that a number moved from which on the picture must be better than with its start; by how many standard errors; share of
the noisiest pixels that may hide it."""


@exclusive("check_numbers")
def check_numbers(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    start: Mapping[str, np.ndarray],
    seconds: float,
    sensitivities: Mapping[str, np.ndarray] = MappingProxyType({}),
    weights: Sequence[np.ndarray] = (),
    known: Mapping[str, np.ndarray] = MappingProxyType({}),
    ends: Mapping[int, Sequence[np.ndarray]] = MappingProxyType({}),
) -> NumbersCheck:
    """Test the problem's numbers by least squares at `values`.

    The derivatives J of the pictures are differences of renders, along directions of which the pictures change independently. The
    covariance of the numbers is (JᵀJ)⁻¹ C (JᵀJ)⁻¹, with the covariance C of Jᵀ r (`statistics.scores`) from the residual r after the step
    below, in each pixel that of a fit without the pixel. It contains the references' noise. If it is large relative to the numbers, the
    references do not determine them. Where the step −(JᵀJ)⁻¹ Jᵀ r is long, the run ended early.

    Textures and grids move along directions that trade off against the numbers, see `add_field_directions`. Other unknowns are fixed, and
    so are those with a prior. Standard errors with fixed unknowns would be too small, so there are none: the numbers are `unchecked`.

    Steps are reported for losses with a linear derivative only: others have their minimum elsewhere. The result is empty if there are
    no numbers (see `Numbers.of`), or if the renderer rejects a value. Pixels that are not finite leave the test.

    Args:
        values: {key: array} at the end.
        start: {key: array} at the start.
        seconds: time after which nothing further is started; the numbers are `unchecked` then.
        sensitivities: sensitivities of textures and grids, see `unrender.sensitivity`; those without one are fixed.
        weights: weights of each view's pixels in the run's steps (`Result`); () if equal. A fit with others has another solution.
        known: {key: standard errors} that the run states. Where they are small, noise of this check leaves no number undetermined.
        ends: {view: independent pictures at the end}, by whose mean the model is tested; {} for no test.
    """
    numbers = Numbers.of(problem, values, start)
    if numbers is None or not compares(problem):
        return NumbersCheck()
    if (affordable := numbers.affordable(_PASSES + 1, seconds if timing.counts() else math.inf)) is None:
        return NumbersCheck(unchecked=numbers.keys)
    stated = np.concatenate([np.ravel(known.get(k, np.full(values[k].size, math.inf))) for k in affordable.keys])
    numbers = replace(affordable, weights=weights, ends=ends, settled=stated < _DOUBTFUL * affordable.sizes)
    try:
        return _of_tested_views(_check(numbers, sensitivities, timing.now() + seconds), numbers, sensitivities)
    except (InputError, np.linalg.LinAlgError):  # a value that the renderer rejects, or matrices without eigenvalues
        return NumbersCheck()


def checked_keys(
    problem: Problem, values: Mapping[str, np.ndarray], start: Mapping[str, np.ndarray]
) -> tuple[str, ...]:
    """Return the keys of the numbers that `check_numbers` tests."""
    numbers = Numbers.of(problem, values, start)
    return () if numbers is None else numbers.keys


@exclusive("compile_check")
def compile_check(problem: Problem, values: Mapping[str, np.ndarray], seconds: float) -> None:
    """Compile the kernels of `check_numbers` if it has time, and `seconds` if renderings are counted."""
    numbers = Numbers.of(problem, values, values)
    if numbers is not None and (numbers := numbers.affordable(_PASSES + 1, seconds)) is not None:
        with contextlib.suppress(InputError):  # a value that the renderer rejects
            for count in (1, 2 * numbers.point.size):
                numbers.pictures(np.tile(numbers.point, (count, 1)), Key(0, 0, _STREAM))


def _check(numbers: Numbers, sensitivities: Mapping[str, np.ndarray], until: float) -> NumbersCheck:
    key, change = Key(0, 0, _STREAM), _SHIFT * numbers.slope()
    widths, longest = _FIRST_WIDTH * numbers.limits, 0.0
    for index in range(_PASSES + 1):
        started = timing.now()
        if started + longest > until:
            return NumbersCheck(unchecked=numbers.keys)
        differences = numbers.differences(np.diag(widths), key.fold(index))
        longest = timing.now() - started
        if index < _PASSES:
            squares, errors = differences.squares()
            changes = np.sqrt(np.maximum(squares, errors) / differences.one[0].size)
            factors = np.clip(change / np.maximum(changes, 1e-30), 1.0 / _CHANGES[index], _CHANGES[index])
            widths = np.minimum(factors * widths, numbers.limits)
    matrix = differences.matrix()
    if not np.isfinite(matrix).all():
        line = f"{listed(numbers.keys)}: no standard errors: too many pixels of the pictures of the test are not finite"
        return NumbersCheck(distorted=line)
    if not matrix.any():
        unseen = {key: f"{key}: no picture depends on its value at the end" for key in numbers.keys}
        zeros = {key: np.zeros(numbers.values[key].size) for key in numbers.keys}
        return NumbersCheck(unseen, errors={key: x + np.inf for key, x in zeros.items()}, steps=zeros, noise=zeros)
    began, last = timing.now(), math.inf if timing.counts() else until - 3.0 * longest
    differences, limits = narrowed(numbers, differences, key.fold(_SHORT), last)
    # Counted renderings need not keep a time, and without those that told nothing new, noise hid numbers that it had not hidden.
    until += (timing.now() - began) * timing.counts()
    moved, fixed = fields_of(numbers, sensitivities)
    if moved:
        half = 0.5 * (timing.now() + until)
        extended = add_field_directions(numbers, differences, moved, sensitivities, change, key.fold(_FIELDS), half)
        if extended is None:
            return NumbersCheck(unchecked=numbers.keys)
        numbers, differences, missing = extended
        fixed |= dict.fromkeys(moved, missing) if missing else {}
    limits = np.append(np.minimum(limits, numbers.limits[: numbers.count]), numbers.limits[numbers.count :])
    short = (limits < numbers.limits).any()
    latest, (factors, share) = differences, independent(differences, limits, change)
    for index in range(_ROUNDS):  # differences that nearly cancel do not tell how the pictures change along their sum
        if share > _WEAK or (short and latest.hidden().any()) or timing.now() + 4.0 * longest > until:
            break
        latest = numbers.differences(latest.directions @ factors, key.fold(_PASSES + 1 + _REPEATS + index))
        factors, share = independent(latest, limits, change)
    judged = _repeated(numbers, latest.directions @ factors, key, until - 2.0 * longest)
    if short and judged[0].hidden().any():  # noise hides short differences
        factors = independent(latest, numbers.limits, change)[0]
        judged = _repeated(numbers, latest.directions @ factors, key, until - 2.0 * longest)
    # Noise may hide how sums of these directions change the pictures.
    mixed = judged[0].mixed(independent(judged[0], numbers.limits, change)[0])
    check = _checked(numbers, _Fit.of(numbers, mixed, *judged[1:]), widths)
    return replace(check, errors={}, unchecked=numbers.keys, fixed=fixed, distorted="", blind=()) if fixed else check


def _of_tested_views(check: NumbersCheck, numbers: Numbers, sensitivities: Mapping[str, np.ndarray]) -> NumbersCheck:
    """Return a check without what it says of numbers that only other views show."""
    least, places = _FLAT * _SHIFT * numbers.slope(), numbers.places()
    keys = tuple(
        key
        for key in check.undetermined
        if shown_elsewhere(numbers.problem, sensitivities.get(key), float(numbers.limits[places[key]].max()), least)
        and not np.isfinite(check.errors.get(key, np.inf)).any()
    )
    undetermined, errors = ({k: x for k, x in of.items() if k not in keys} for of in (check.undetermined, check.errors))
    return replace(check, undetermined=undetermined, errors=errors, elsewhere=keys)


def _repeated(
    numbers: Numbers, directions: np.ndarray, key: Key, until: float
) -> tuple[Differences, np.ndarray, np.ndarray]:
    """Return the differences along directions and the residuals (2, P, 3) at the end and with the start's numbers, as means of repeats."""
    weights, repeats, count = np.zeros(directions.shape[1]), 0, directions.shape[1]
    began = np.append(numbers.start, numbers.point[numbers.count :])
    residuals, before = np.zeros((2, 2, *numbers.references().shape))
    differences = None
    while differences is None or (repeats < _REPEATS and timing.now() < until):
        own = key.fold(_PASSES + 1 + repeats)
        more = numbers.differences(directions, own)
        # The end of a long difference may have rare bright samples, such as at a low roughness; repeats that have them count less.
        weights += more.weights()
        differences = more if differences is None else differences.moved(more, more.weights() / weights)
        for half in (0, 1):  # as many pictures as for the differences
            for index in range(count):
                residuals[half] += numbers.residual(numbers.point, own.fold(2 + 2 * index + half))
            before[half] += numbers.residual(began, own.fold(2 + half))
        repeats += 1
    return differences, residuals / (repeats * count), before / repeats


@dataclass(frozen=True)
class _Fit:
    """Joint least-squares fit of n numbers and k directions of textures and grids.

    Attributes:
        covariance: covariance from the references' noise, as the residual after the step shows it, (n + k, n + k).
        error: standard errors of the numbers, (n,); infinite along directions whose changes the noise of this check hides.
        own: the same from the noise of this check, its slopes included, (n,).
        step: step of the numbers, (n,).
        unseen: largest changes of the numbers along each hidden direction that leaves them open, signed, (n, number of hidden directions).
        blind: largest changes of the numbers along the other hidden directions, of whose slopes this check knows upper limits, (n,).
        better: standard errors by which the picture is better than with the start's numbers.
        beyond: distance of the solution beyond a bound of the number, (n,); 0 where noise may explain it.
        distortions: what references look like, and the changes of the numbers if they were so, (n,), see `distortions_of_fit`.
        unexplained: see `unexplained_share`.
    """

    covariance: np.ndarray
    error: np.ndarray
    own: np.ndarray
    step: np.ndarray
    unseen: np.ndarray
    blind: np.ndarray | float = 0.0
    better: float = math.inf
    beyond: np.ndarray = field(default_factory=lambda: np.zeros(1))
    distortions: Sequence[tuple[str, np.ndarray]] = ()
    unexplained: float = 0.0

    @classmethod
    def of(
        cls, numbers: Numbers, differences: Differences, residuals: np.ndarray, before: np.ndarray | None = None
    ) -> _Fit:
        """Fit differences along directions to two independent residuals (2, P, 3). `before` are those with the start's numbers."""
        matrix, (squares, errors) = differences.matrix(), differences.squares()
        # Along these no change is seen: the variance is at least that of the largest change that noise may hide.
        hidden = differences.hidden()
        shared = np.where(hidden, matrix, 0.0)
        matrix[hidden, :] = matrix[:, hidden] = 0.0
        least = 1e-12 * float(np.abs(squares).max()) + 1e-200
        np.fill_diagonal(matrix, np.where(hidden, np.maximum(squares, 0.0) + ERRORS * errors + least, np.diag(matrix)))
        units = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        inverse = np.linalg.pinv(matrix / np.outer(units, units), rcond=1e-6, hermitian=True) / np.outer(units, units)
        slopes = differences.average()
        share = math.sqrt(len(numbers.views) / len(numbers.problem.views))
        tangents, n = numbers.tangents(), numbers.count
        changes = tangents @ differences.directions

        def covariance(one: np.ndarray, other: np.ndarray, by: np.ndarray = slopes) -> np.ndarray:
            """Return the covariance of numbers and factors for residuals (P, 3) with independent rendering noise, times slopes."""
            middle = np.zeros_like(matrix)
            for parts in zip(*map(numbers.by_view, (by, one[None], other[None])), strict=True):
                middle += scores.covariance(*((parts[0] * of).sum(axis=3) for of in parts[1:]))
            middle = scores.positive_part(middle)
            middle[hidden, :] = middle[:, hidden] = 0.0
            mean_square = _CHANNELS * max(float(np.mean(one * other)), 0.0)
            middle += np.diag(np.where(hidden, mean_square * units**2, 0.0))
            return share**2 * (changes @ inverse @ middle @ inverse @ changes.T)

        residual, noise = (0.5 * (residuals[0] + sign * residuals[1]) for sign in (1.0, -1.0))
        along = -inverse @ np.where(hidden, 0.0, np.tensordot(slopes, residual, axes=2))
        after = residuals + np.tensordot(along, slopes, axes=1)  # a run that ended early leaves more
        total = covariance(*scores.without_own_pixel(after, slopes, slopes, inverse))
        total = total if residual.size > len(total) else np.full_like(total, np.inf)
        left = 0.5 * (after[0] + after[1])  # the noise of the slopes moves the solution, too
        noises = covariance(noise, noise) + covariance(left, left, 0.5 * (differences.one - differences.other))
        error, own = (np.sqrt(np.maximum(np.diag(x)[:n], 0.0)) for x in (total, noises))
        step = numbers.inside((numbers.point + changes @ along)[None])[0] - numbers.point
        rounding = 1e-6 * np.abs(numbers.point[:n])
        beyond = (changes @ along - step)[:n]
        beyond = np.where(np.abs(beyond) > ERRORS * np.hypot(error, own) + rounding, beyond, 0.0)
        flat = squares + ERRORS * errors < (_FLAT * _SHIFT * numbers.slope()) ** 2 * residual.size
        # The noise of this check says nothing about references that have much less of it.
        comparable = np.mean(after[0] * after[1]) > _COMPARABLE**2 * np.mean(noise * noise)
        # Differences along poses are noisy at a few pixels, such as a lamp's edge, which hide what all others show.
        open_ = flat[None] | (~(numbers.rigid | numbers.settled)[:, None] & comparable)
        # What the other directions explain of a hidden one belongs to it: numbers that trade off against it move along.
        seen_inverse = np.where(hidden, 0.0, inverse)
        unseen = (changes - changes @ seen_inverse @ shared)[:n] * (hidden[None] & open_)
        blind = np.abs(changes[:n] * (hidden[None] & ~open_)).max(axis=1, initial=0.0)
        better = math.inf if before is None else _better(residuals, before)
        seen = np.where(hidden[:, None, None], 0.0, slopes)
        looks_like = distortions_of_fit(numbers, residuals, after, seen, seen_inverse)
        distortions = [(words, changes[:n] @ moves) for words, moves in looks_like]
        return cls(
            total, error, own, step[:n], unseen[:, hidden], blind, better, beyond,
            distortions, unexplained_share(numbers, seen, seen_inverse),
        )  # fmt: skip


def _better(residuals: np.ndarray, before: np.ndarray) -> float:
    """Return by how many standard errors residuals (2, P, 3) are smaller than those `before`, with or without the noisiest pixels."""
    changes = (before[0] * before[1] - residuals[0] * residuals[1]).sum(axis=1)
    noise = np.square(np.stack([residuals[0] - residuals[1], before[0] - before[1]])).sum(axis=(0, 2))
    calm = changes[noise <= np.quantile(noise, 1.0 - _NOISY)]
    return max(float(x.sum()) / max(math.sqrt(float(np.square(x).sum())), 1e-300) for x in (changes, calm))


def _checked(numbers: Numbers, fit: _Fit, widths: np.ndarray) -> NumbersCheck:
    """Return the check of a fit: standard errors, and a line for each number that is undetermined or had not settled."""
    posed, longest = numbers.rigid | (numbers.sizes <= 0.0), 2.0 * numbers.limits[: numbers.count]
    sizes = np.where(posed, np.maximum(numbers.sizes, np.minimum(_OF_WIDTHS * widths, longest)), numbers.sizes)
    unseen = np.abs(fit.unseen) > _DOUBTFUL * np.where(posed, longest, sizes)[:, None]
    error = np.where(unseen.any(axis=1), np.inf, np.hypot(fit.error, np.linalg.norm(fit.unseen, axis=1)))  # shared
    n, spread = numbers.count, np.outer(fit.error, fit.error)
    # An open number may be anywhere in its range, and numbers that trade off against it move along.
    total = np.nan_to_num(fit.covariance[:n, :n], posinf=0.0, neginf=0.0) + fit.unseen @ fit.unseen.T
    along = np.where(error > sizes, np.abs(total) / np.maximum(np.diag(total), 1e-300) * longest, 0.0)
    blind = fit.blind > np.maximum(error := np.maximum(error, along.max(axis=1)), fit.own)
    error = np.hypot(error, fit.blind * (blind.any() & ~blind))  # others share their directions
    open_ = error > _DOUBTFUL * sizes
    together = (np.abs(fit.covariance[:n, :n]) > _TOGETHER * spread) | (along > _DOUBTFUL * sizes[:, None])
    together |= (unseen[:, None] & unseen[None]).any(axis=2)
    shared = open_ & (_shared_with_fields(fit.covariance, n) | unseen.any(axis=1))
    of_step = np.maximum(error, own := np.where(blind, np.inf, fit.own))  # exact references leave this check's noise
    far = np.abs(fit.step) > (least := np.maximum(_STEP_ERRORS * of_step, _FURTHER * sizes))
    outside = (np.abs(fit.beyond) > least) & ~far  # a step from far away may be too long
    further = far & ~outside.any()  # more steps lead no further than the bound
    larger = of_step > sizes  # not linear beside an open number
    shown, more = np.minimum(of_step, sizes), " or more" * bool(larger.any())
    # Least squares is linear: a picture that is no better than with the start, many standard errors away, refutes these errors.
    moved = np.abs(numbers.tangents()[:n, :n] @ (numbers.point[:n] - numbers.start))
    refuted = (moved > _FAR * of_step) & (fit.better < _BETTER)
    undetermined, unfinished = {}, {}
    for key, of in numbers.places().items():
        if refuted[of].any():
            undetermined[key] = (
                f"{key}: the pictures are no better than with its initial value, beyond noise, so it may be in a local minimum; give more "
                "samples, bounds, or another start"
            )
        elif outside[of].any() and numbers.problem.loss.linear:
            unfinished[key] = (
                f"{key}: the least-squares solution is beyond its bound by {_numbers(fit.beyond[of])}, with the standard error "
                f"{_numbers(of_step[of])}; widen its bounds, or something that is not among the unknowns is wrong"
            )
        elif open_[of].any():
            others = [k for k, x in numbers.places().items() if k != key and together[of][open_[of]][:, x].any()]
            others += [*numbers.fields] * bool(shared[of].any())
            together_with = f", together with {listed(others)}" if others else ""
            limit = "" if larger[of].all() else f"determines it to ± {_numbers(shown[of])}{more}"
            undetermined[key] = (
                f"{key}: a least-squares test at the end {limit or 'does not determine it'}{together_with} (with the noise of the "
                "references and of the test); fix one of these, add views or samples, or narrow the bounds"
            )
        elif further[of].any() and numbers.problem.loss.linear:
            unfinished[key] = (
                f"{key}: the run ended before it settled: a least-squares step from its end moves it by {_numbers(fit.step[of])}, with the "
                f"standard error {_numbers(of_step[of])}; give more steps or seconds, or resume the run"
            )
    # Beyond its own size an error is not linear, and at a bound it is not that of the solution.
    known = np.where((error > sizes) | refuted | (fit.beyond != 0.0), np.inf, error)
    errors, steps, noise = ({k: x[of] for k, of in numbers.places().items()} for x in (known, fit.step, own))
    hidden = tuple(k for k, of in numbers.places().items() if blind[of].any() and k not in undetermined)
    if line := _distorted(numbers, fit, of_step, bool(refuted.any())):
        sure = refuted | unseen.any(axis=1) | (fit.own > sizes)  # its residual leaves other numbers open
        undetermined = {key: text for key, text in undetermined.items() if sure[numbers.places()[key]].any()}
        return NumbersCheck(undetermined, unfinished, {}, steps, noise, numbers.keys, distorted=line)
    return NumbersCheck(undetermined, unfinished, errors, steps, noise, blind=hidden)


def _distorted(numbers: Numbers, fit: _Fit, of_step: np.ndarray, refuted: bool) -> str:
    """Return a line about a distortion of a reference that would move numbers by several standard errors (n,), about a difference that no
    numbers explain, or about pictures with as many values as numbers; "" for none. Where numbers have not settled, or are `refuted`, their
    pictures may differ as if so."""
    if numbers.references().size == numbers.count:  # a fit leaves no residual, which tells the references' noise
        return (
            f"{listed(numbers.keys)}: no standard errors: the pictures have as few values as these numbers, of which others may give the "
            "same pictures; add pixels or views"
        )
    line = f"{listed(numbers.keys)}: no standard errors: the pictures differ from the references "
    # What a step leaves of the pictures may be its curvature, however small a part of the number's range it is.
    unsettled = refuted or bool((np.abs(fit.step) > _STEP_ERRORS * of_step).any())
    first = "give more steps or another start, then " * unsettled
    for words, moves in fit.distortions:
        far = [k for k, of in numbers.places().items() if (np.abs(moves[of]) > _DISTORTED * of_step[of]).any()]
        if moved := [f"{key} by {_numbers(moves[numbers.places()[key]])}" for key in far]:
            return f"{line}{words}, which would move {listed(moved)}; {first}check the references and the camera"
    line += f"by {100.0 * fit.unexplained:.2g} % {SMOOTH}; {first}check what is not among "
    return f"{line}the unknowns, such as lights, the camera and the tone curve" if fit.unexplained else ""


def _shared_with_fields(covariance: np.ndarray, n: int) -> np.ndarray:
    """Return which of n numbers would have less than half their standard error if factors of textures and grids were known, (n,)."""
    own, shared, factors = covariance[:n, :n], covariance[:n, n:], covariance[n:, n:]
    return np.diag(own - shared @ np.linalg.pinv(factors, hermitian=True) @ shared.T) < 0.25 * np.diag(own)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(map(formatting.number, values))
