"""Panels of pictures: views and recovered maps of one run, or of several methods side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender.app.report import tone_mapping
from unrender.app.report.tone_mapping import INLINE, ColourBar, Picture, PictureEncoder
from unrender.core import periodic
from unrender.display import formatting, pictures
from unrender.display.pictures import is_map
from unrender.losses import metrics
from unrender.runs.folder.reader import RunFolder, ViewPictures
from unrender.runs.image_sensitivity import around, insensitive

_TENS = -3.0  # the lower end of the colour scale of a sensitivity: log₁₀ of the ratio to the greatest


@dataclass(frozen=True)
class Slider:
    """Two superimposed pictures, with a handle that moves the boundary between them."""

    left: Picture
    right: Picture
    left_label: str
    right_label: str
    caption: str = ""
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """One picture and its caption; `bar` is its legend if its colours represent numbers."""

    picture: Picture
    caption: str
    note: str = ""
    bar: ColourBar | None = None


@dataclass(frozen=True)
class Panel:
    """Stacks of pictures, side by side on a wide screen. Those of `independent` stacks show different regions."""

    title: str
    note: str
    stacks: tuple[tuple[Slider | Figure, ...], ...]
    first_is_large: bool
    independent: bool = False


def view_of_run(view: int, shown: ViewPictures, encoder: PictureEncoder = INLINE, name: str = "Result") -> Panel:
    """Return the panel of a view of a run ("Current" while it continues): reference, result, start, errors, the method's maps."""
    factor = metrics.exposure(shown.reference, shown.mask)
    what = name.lower()
    error = tone_mapping.absolute_error(shown.result, shown.reference, shown.mask)
    before = None if shown.initial is None else tone_mapping.absolute_error(shown.initial, shown.reference, shown.mask)
    high = tone_mapping.colour_limit(error if before is None else before)
    result = encoder.colour(shown.result, factor, f"View {view}: the {what}")
    stacks: list[tuple[Slider | Figure, ...]] = [
        (Slider(encoder.colour(shown.reference, factor, f"View {view}: the reference"), result, "Reference", name),)
    ]
    if shown.initial is not None and before is not None:
        picture = encoder.colour(shown.initial, factor, f"View {view}: before the first step")
        stacks.append((Figure(picture, "Start"),))
        stacks.append(
            (_error(encoder, before, high, "Error at the start", f"View {view}: error before the first step"),)
        )
    pictures = _maps_of_view(view, shown, encoder)
    stacks += [(figure,) for figure in pictures or [Figure(result, name)]]
    stacks.append((_error(encoder, error, high, f"Error of the {what}", f"View {view}: error of the {what}"),))
    return Panel(f"View {view}", _exposure_note(factor), tuple(stacks), True)


def _maps_of_view(view: int, shown: ViewPictures, encoder: PictureEncoder) -> list[Figure]:
    figures = []
    if shown.control_weight is not None:
        weight = np.mean(shown.control_weight, axis=-1)
        picture = encoder.false_colour(weight, 0.0, 1.0, f"View {view}: control weight per pixel")
        bar = tone_mapping.colour_bar(0.0, 1.0, "Control weight")
        note = f"mean {_finite_mean(weight):.2f}; 1 uses the full history, 0 discards it"
        figures.append(Figure(picture, "Control weight", note, bar))
    if shown.pixel_probability is not None:
        density = shown.pixel_probability
        high = tone_mapping.colour_limit(density)
        picture = encoder.false_colour(density, 0.0, high, f"View {view}: probability of each pixel")
        bar = tone_mapping.colour_bar(0.0, high, "Probability that a pixel is sampled")
        figures.append(Figure(picture, "Pixel probability", f"mean {formatting.number(_finite_mean(density))}", bar))
    return figures


def view_of_methods(view: int, shown: Mapping[str, ViewPictures]) -> Panel:
    """Return the panel of a view: the result of each method beside the reference, and its error, on common scales."""
    first = next(iter(shown.values()))
    reference, factor = first.reference, metrics.exposure(first.reference, first.mask)
    errors = {label: tone_mapping.absolute_error(of.result, of.reference, of.mask) for label, of in shown.items()}
    high = max(tone_mapping.colour_limit(error) for error in errors.values())
    stacks = tuple(
        (
            Slider(
                INLINE.colour(reference, factor, f"View {view}: the reference"),
                INLINE.colour(of.result, factor, f"View {view}: the result of {label}"),
                "Reference",
                label,
            ),
            _error(INLINE, errors[label], high, f"Error of {label}", f"View {view}: error of {label}"),
        )
        for label, of in shown.items()
    )
    return Panel(f"View {view}", _exposure_note(factor), stacks, False)


def map_of_run(run: RunFolder, key: str, encoder: PictureEncoder = INLINE) -> Panel:
    """Return the panel of a recovered map beside its truth, or its start if that is unknown, with its sensitivity if known."""
    maps = (run.parameters, run.initial, run.truth, run.sensitivity, run.standard_error, run.data_share)
    known = (of.get(key) for of in maps)
    columns = run.measure(key).repeated
    result, initial, truth, sensitivity, deviation, share = (
        x if x is None or not is_map(x) else periodic.interior(x, columns) for x in known
    )
    assert result is not None
    scale = ColourScale(result if truth is None or not is_map(truth) else truth)
    stacks: list[tuple[Slider | Figure, ...]] = []
    planes = pictures.planes(result)
    for label, plane in planes.items():
        start, true_plane = pictures.planes(initial).get(label), pictures.planes(truth).get(label)
        errors = {
            caption: tone_mapping.absolute_error(one, true_plane)
            for caption, one in (("Error at the start", start), ("Error", plane))
            if one is not None and true_plane is not None and one.shape == true_plane.shape
        }
        high = tone_mapping.colour_limit(next(iter(errors.values()))) if errors else 1.0
        column: list[Slider | Figure] = [_compare_map(encoder, scale, key, label, plane, start, true_plane)]
        if true_plane is not None and start is not None:
            column.append(
                Figure(scale.picture(encoder, start, f"{key} {label}: before the first step"), "Start", "", scale.bar)
            )
        for what, error in errors.items():
            if what == "Error":
                column.append(
                    Figure(scale.picture(encoder, plane, f"{key} {label}: recovered"), "Recovered", "", scale.bar)
                )
            column.append(_error(encoder, error, high, what, f"{key} {label}: {what.lower()}"))
        if sensitivity is not None and (changes := pictures.planes(sensitivity).get(label)) is not None:
            column.append(
                _sensitivity(encoder, changes, float(np.max(around(sensitivity))), f"{key} {label}: sensitivity")
            )
        if deviation is not None and share is not None:
            column += _uncertainty(
                encoder, pictures.planes(deviation)[label], pictures.planes(share)[label], f"{key} {label}"
            )
        if len(planes) == 1:
            stacks += [(item,) for item in column]
        else:
            stacks.append(tuple(column))
    reasons = [line.removeprefix(f"{key}: ") for line in run.record.without_errors if line.startswith(f"{key}: ")]
    note = "; ".join([_map_note(result, scale), *reasons])
    return Panel(key, note, tuple(stacks), len(planes) == 1, len(planes) > 1)


def maps_of(run: RunFolder, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays that are displayed as images, without the repeated columns of environment maps."""
    inner = {key: periodic.interior(x, run.measure(key).repeated) for key, x in arrays.items() if is_map(x)}
    return {key: x for key, x in inner.items() if is_map(x)}


def map_of_methods(key: str, results: Mapping[str, np.ndarray], truth: np.ndarray) -> Panel:
    """Return the panel of a map: the result of each method beside the truth, and its error, on one scale; a volume's middle slice."""
    scale = ColourScale(truth)
    label, true_plane = next(iter(pictures.planes(truth).items()))
    planes = {name: pictures.planes(result).get(label) for name, result in results.items()}
    errors = {
        name: tone_mapping.absolute_error(plane, true_plane)
        for name, plane in planes.items()
        if plane is not None and plane.shape == true_plane.shape
    }
    high = max([tone_mapping.colour_limit(error) for error in errors.values()], default=1.0)
    stacks = []
    for name, plane in planes.items():
        if plane is None:
            continue
        column: list[Slider | Figure] = [_compare_map(INLINE, scale, key, label, plane, None, true_plane, name)]
        if name in errors:
            column.append(_error(INLINE, errors[name], high, f"Error of {name}", f"{key} {label}: error of {name}"))
        stacks.append(tuple(column))
    return Panel(key, _map_note(truth, scale), tuple(stacks), False)


class ColourScale:
    """The mapping of the values of one parameter to colours; one array fixes it for all arrays that are compared with this one.

    One channel: false colour over the range of `fixed_by`. Three channels: sRGB, with an exposure below 1 only where a value exceeds 1.
    """

    def __init__(self, fixed_by: np.ndarray):
        finite = fixed_by[np.isfinite(fixed_by)]
        self.low, self.high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        self.scalar = fixed_by.ndim == 2 or fixed_by.shape[-1] == 1
        self.factor = 1.0 if self.scalar or self.high <= 1.0 else metrics.exposure(fixed_by[..., :3])
        if self.scalar and self.high - self.low < 1e-6 * max(abs(self.high), 1.0):
            self.low, self.high = min(0.0, self.low), max(1.0, self.high)

    def picture(self, encoder: PictureEncoder, plane: np.ndarray, alt: str) -> Picture:
        """Encode (H, W, C) values as a picture of the page."""
        if plane.shape[-1] == 1:
            return encoder.false_colour(plane[..., 0], self.low, self.high, alt)
        return encoder.colour(plane[..., :3], self.factor, alt)

    @property
    def bar(self) -> ColourBar | None:
        """The legend; None for several channels."""
        return tone_mapping.colour_bar(self.low, self.high, "Value") if self.scalar else None


def _compare_map(
    encoder: PictureEncoder,
    scale: ColourScale,
    key: str,
    label: str,
    plane: np.ndarray,
    start: np.ndarray | None,
    reference: np.ndarray | None,
    name: str = "Recovered",
) -> Slider | Figure:
    picture = scale.picture(encoder, plane, f"{key} {label}: {name}")
    caption = label.capitalize()
    if reference is not None:
        return Slider(scale.picture(encoder, reference, f"{key} {label}: the truth"), picture, "Truth", name, caption)
    if start is not None:
        return Slider(scale.picture(encoder, start, f"{key} {label}: start"), picture, "Start", name, caption)
    return Figure(picture, caption or name, "", scale.bar)


def _error(encoder: PictureEncoder, error: np.ndarray, high: float, caption: str, alt: str) -> Figure:
    note = f"mean {formatting.number(_finite_mean(error))}"
    return Figure(encoder.error(error, high, alt), caption, note, tone_mapping.error_bar(high))


def _sensitivity(encoder: PictureEncoder, sensitivity: np.ndarray, greatest: float, alt: str) -> Figure:
    """Return the figure of the sensitivity of the images to each texel, in powers of ten below the greatest."""
    with np.errstate(divide="ignore", invalid="ignore"):
        tens = np.nan_to_num(np.log10(around(sensitivity) / greatest), nan=_TENS, neginf=_TENS)
    bar = tone_mapping.colour_bar(_TENS, 0.0, "Change of the images, log₁₀ of the greatest")
    note = f"{insensitive(sensitivity).mean():.0%} of the texels hardly change the images"
    return Figure(encoder.false_colour(tens, _TENS, 0.0, alt), "Sensitivity", note, bar)


def _uncertainty(encoder: PictureEncoder, deviation: np.ndarray, share: np.ndarray, alt: str) -> list[Slider | Figure]:
    """Return the figures of the standard error of each texel, and of the weight of the references in its value."""
    decided = np.mean(share, axis=-1)
    high = tone_mapping.colour_limit(np.mean(deviation, axis=-1))
    bar = tone_mapping.colour_bar(0.0, 1.0, "Weight of the references")
    note = f"{np.mean(decided >= 0.5):.0%} decided by the references; the rest by the start, smoothing or a prior"
    picture = encoder.false_colour(decided, 0.0, 1.0, f"{alt}: weight of the references")
    return [
        _error(encoder, np.mean(deviation, axis=-1), high, "Standard error", f"{alt}: standard error"),
        Figure(picture, "Decided by the references", note, bar),
    ]


def _finite_mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def _exposure_note(factor: float) -> str:
    return f"Exposure ×{formatting.number(factor)}"


def _map_note(array: np.ndarray, scale: ColourScale) -> str:
    shape = " × ".join(str(n) for n in array.shape)
    if scale.scalar:
        return f"{shape}; colours from {formatting.number(scale.low)} to {formatting.number(scale.high)}"
    return f"{shape}; in sRGB" + (f" at exposure ×{formatting.number(scale.factor)}" if scale.factor != 1.0 else "")
