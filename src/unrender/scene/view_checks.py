"""Validation of views and of their images.

References are linear in what the camera saw. Files and arrays of 8 and 16 bits are taken as sRGB and linearised, with a notice. `.exr`,
`.hdr` and floating-point arrays are linear. Masks are taken as they are.

| `pixel_format` of the film | floating-point array or `.npy` | comparison |
|---|---|---|
| `rgb`, `rgba` | (H, W, 3) or (H, W, 4) | red, green and blue |
| `xyz`, `xyza` | (H, W, 3) or (H, W, 4) | converted to RGB |
| `luminance`, `luminance_alpha` | (H, W), (H, W, 1) or (H, W, 2) | with the luminance of the image |

A floating-point file with channels R, G and B is refused for a film of XYZ, since `mi.util.write_bitmap` names XYZ values so. Alpha of
8- and 16-bit pictures restricts the view's mask to opaque pixels: at edges, a rendered pixel mixes the object with what is behind it.
Alpha of floating-point pictures is left out with a notice, since Mitsuba's films multiply colours with it. Negative values are refused,
unless the film's reconstruction filter has negative lobes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.io import images, parameter_values
from unrender.io.stored_pictures import PictureStore, StoredPicture
from unrender.io.toml_lines import FieldError
from unrender.losses import Censored, Loss
from unrender.rendering.picture_format import PictureFormat, format_of
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.scene.bounds import angle_notice
from unrender.scene.references import ON_DEVICE, View
from unrender.scene.validation import is_number

_DARKEST = -1e-4  # ratio to the largest value above which negative values count as rounding error

_MOST_COLOUR = 0.05
"""Largest difference of a mask's channels, which compression may leave; also the largest relative one of an alpha that is no mask."""

_WHITES = 255, 65535  # White in 8 and 16 bits. A mask whose largest value is the inverse of one was stored as ones.


@dataclass(frozen=True)
class Reference:
    """A reference in the form that losses compare.

    Attributes:
        values: (H, W, 3) float32, linear RGB; luminance is repeated in each channel.
        alpha: (H, W), 1 for opaque pixels and 0 for others of an 8- or 16-bit image with alpha; else None.
        limited: whether values are clipped at white.
        notices: one line for each conversion.
        loses_alpha: whether the source has alpha that becomes no mask, and the film stores none.
    """

    values: np.ndarray
    alpha: np.ndarray | None
    limited: bool
    notices: tuple[str, ...]
    loses_alpha: bool = False


def read_reference(source: Any, form: PictureFormat) -> Reference:
    """Read the reference from a file or an array.

    An array, or a .npy file, contains the film's format, and sRGB in 8 or 16 bits. Other files specify their own colour space. Opaque
    pixels of 8- and 16-bit images become a mask. Alpha of floating-point images is ignored, because films store premultiplied colours.

    Raises `InputError` as `images.read` does, and if the number of channels differs from the film's or radiance is negative. It also
    does so for floating-point files labelled RGB of films that store XYZ: `mi.util.write_bitmap` labels XYZ values so.
    """
    if form.aov:
        return _of_aov(source, form.aov)
    grey = form.colour == "luminance"
    channels = {"luminance": (1, 2), "xyz": (3, 4), "rgb": (1, 3, 4)}[form.colour]
    try:
        image = images.read(source, alpha=True, channels=channels)
        profile = images.check_metadata(source, bool(image.notice))
    except InputError as error:
        if form.colour == "rgb" or "expected an array of shape" not in str(error):
            raise
        raise InputError(f"{error}: the film's pixel_format is {form.colour}") from error
    values = image.values
    if grey and values.shape[2] != 1:
        raise InputError(
            "it has three channels and the film's pixel_format is luminance; use an image of one channel, or the pixel_format rgb"
        )
    xyz = form.colour == "xyz"
    if xyz and values.shape[2] == 1 and not image.notice:
        raise InputError(
            "it has one channel, but the film's pixel_format is xyz; use an image of X, Y and Z, or the pixel_format luminance"
        )
    of_film = not image.notice and _is_of_film(source)
    if xyz and not (image.notice or image.labelled_xyz or of_film):
        raise InputError(
            "the file names its channels R, G and B, but the film's pixel_format is xyz, so either may be meant; "
            "write XYZ values to a .npy file, or use the pixel_format rgb"
        )
    if not form.signed:
        _check_not_negative(values)
    notices = [notice for notice in (image.notice, profile) if notice]
    if xyz and of_film:
        values = images.xyz_to_rgb(values)
        notices.append("is in XYZ, as the film stores it, and is converted to RGB")
    elif values.shape[2] == 1 and not grey:
        notices.append("has one channel, with which red, green and blue of the image are each compared")
    elif grey:
        notices.append("is luminance, with which the image's luminance is compared")
    if isinstance(source, (str, Path)) and not values.any():  # arrays of zeros are placeholders
        notices.append("is 0 at every pixel; check the file, or leave the view out")
    full = np.array(np.broadcast_to(values, (*values.shape[:2], 3)))
    loses_alpha = image.premultiplied and not form.stores_alpha
    alpha = None if image.premultiplied else _opaque(image.alpha)
    return Reference(full, alpha, bool(image.notice), tuple(notices), loses_alpha)


def _of_aov(source: Any, name: str) -> Reference:
    """Read the reference of an AOV. The alpha of a mask in 8 or 16 bits is the mask; other integer values are sRGB albedos."""
    image = images.read(source, alpha=True)
    images.check_metadata(source, name == "albedo" and bool(image.notice))
    values, notices = image.values, []
    if name == "mask" and image.notice:
        values, notices = _unscaled(source)
    elif name == "albedo":
        notices += [image.notice] if image.notice else []
    elif image.notice:
        raise InputError(f"8- and 16-bit values cannot be a {name}; use a floating-point file or array")
    if name in ("sh_normal", "position") and values.shape[2] != 3:
        raise InputError(f"expected the three coordinates of a {name}, got one channel")
    if name in ("depth", "mask") and values.shape[2] == 3 and np.ptp(values, axis=2).any():
        raise InputError(f"expected one channel, or three equal ones, of a {name}")
    if name in ("mask", "albedo") and not arrays.all_within(values, 0.0, 1.0):
        raise InputError(f"expected values from 0 to 1, got {values.min():g} to {values.max():g}")
    if name == "depth":
        _check_not_negative(values)
    full = np.array(np.broadcast_to(values, (*values.shape[:2], 3)))
    alpha = _opaque(image.alpha) if name == "albedo" and not image.premultiplied else None
    return Reference(full, alpha, False, tuple(notices))


def _opaque(alpha: np.ndarray | None) -> np.ndarray | None:
    """Return 1 for opaque pixels and 0 for others, (H, W); None for None.

    The colour under straight alpha is the object's alone, but a rendered pixel at an edge mixes it with what is behind.
    """
    return None if alpha is None else (alpha >= images.OPAQUE).astype(np.float32)


def _is_of_film(source: Any) -> bool:
    """Return whether floating-point values are in the film's format, with no colour space of their own."""
    if isinstance(source, (str, Path)):
        return Path(source).suffix.lower() == ".npy"
    return not images.is_bitmap(source)


def _check_not_negative(values: np.ndarray) -> None:
    bad = values < _DARKEST * max(float(values.max()), 0.0)
    advice = "clip them at 0, or use the same reconstruction filter with negative lobes in the film"
    images.refuse_pixels(bad, "negative", f", but radiance is not; {advice}")


_WHITE = 0.001  # fraction of saturated pixels from which a notice is given


def check_views(views: Sequence[View], renderer: Renderer, loss: Loss) -> tuple[tuple[View, ...], list[str]]:
    """Return the views with their images, in memory or in a file if they are large, and notices, except of saturated pixels that the loss
    handles. Raises `FieldError`."""
    checked, notices, losing, resolutions = [], [], list[int](), renderer.resolutions()
    total = sum(12 * math.prod(resolutions[view.sensor]) for view in views)
    store = PictureStore() if total > ON_DEVICE else None
    for number, one in enumerate(views):
        view, notes, loses_alpha = _check_view(number, one, resolutions, renderer, not isinstance(loss, Censored))
        checked.append(view if store is None else _stored(view, store))
        notices += notes
        losing += [number] if loses_alpha else []
    if losing:
        have = f"view {losing[0]}: reference has" if len(losing) == 1 else f"references of {len(losing)} views have"
        notices.append(f"{have} alpha, which is left out; if it is a mask, give it as the view's mask")
    return tuple(checked), notices


def known_angles(views: Iterable[View], known: Mapping[str, ParameterInfo]) -> list[str]:
    """Return a notice for each known value of a view, or of its file, that is an angle above a full turn."""
    notices = []
    for index, view in enumerate(views):
        for key in [key for key in view.known or {} if key in known and known[key].angle]:
            value, _ = parameter_values.fill((view.known or {})[key], known[key].shape, known[key].conversion)
            line = angle_notice(known[key], value)
            notices += [f"view {index}: {key}: {line}"] if line else []
    return notices


def check_sensor(index: int, view: View, count: int) -> None:
    """Raise `FieldError` unless the `index`-th view has one of `count` sensors."""
    if isinstance(view.sensor, bool) or not isinstance(view.sensor, int) or not 0 <= view.sensor < count:
        have = f"0 to {count - 1}" if count > 1 else "0, the only sensor"
        raise FieldError(
            ("views", index, "sensor"), f"expected {have}, got {in_words(view.sensor)}", f"view {index}: sensor"
        )


def _check_view(
    index: int, view: View, resolutions: Sequence[tuple[int, int]], films: Renderer, tell_saturated: bool
) -> tuple[View, list[str], bool]:
    """Return the view with reference (H, W, 3) and mask (H, W) as float32 arrays, notices (of saturated pixels if `tell_saturated`), and
    `Reference.loses_alpha`. Raises `FieldError` for an invalid field."""
    owner = f"view {index}"

    def wrong(field: str, what: str | Exception) -> FieldError:
        return FieldError(("views", index, field), str(what), f"{owner}: {field}")

    if not is_number(view.weight) or view.weight <= 0:
        raise wrong("weight", f"expected a number above 0, got {in_words(view.weight)}")
    height, width = resolutions[view.sensor]
    notices: list[str] = []
    limited, alpha, loses_alpha = None, None, False  # the reference, if it is clipped at white; its alpha
    try:
        if isinstance(view.reference, StoredPicture):
            _check_size(view.reference, height, width, view.reference)
            reference = view.reference
        else:
            read = read_reference(view.reference, format_of(films, view.sensor))
            reference, alpha, loses_alpha = read.values, read.alpha, read.loses_alpha
            _check_size(reference, height, width, view.reference)
            notices += [f"{owner}: reference {notice}" for notice in read.notices]
            limited = reference if read.limited else None
    except InputError as error:
        raise wrong("reference", error) from error
    mask = view.mask
    if view.mask is not None and not isinstance(view.mask, StoredPicture):
        try:
            mask, notes = _read_mask(view.mask, height, width)
            notices += [f"{owner}: mask {notice}" for notice in notes]
        except InputError as error:
            raise wrong("mask", error) from error
    if alpha is not None:
        mask = alpha if mask is None else np.asarray(mask) * alpha
        if not mask.any():
            what = "its alpha is below 1 wherever the mask is above 0, so no pixel would count; save it without alpha"
            raise wrong("reference", what)
    counted = None if mask is None else np.asarray(mask) > 0
    if tell_saturated and limited is not None and (white := _saturated(limited, counted)) >= _WHITE:
        notices.append(
            f"{owner}: {white:.1%} of the reference's pixels are saturated: set the loss Censored, which treats them as lower bounds"
        )
    return replace(view, reference=reference, mask=mask, weight=float(view.weight)), notices, loses_alpha


def _read_mask(source: Any, height: int, width: int) -> tuple[np.ndarray, list[str]]:
    """Return a mask (H, W), and notices. Raises `InputError` for colours, and for values outside [0, 1] or 0 everywhere."""
    mask, notices = _unscaled(source)
    images.check_metadata(source)
    _check_size(mask, height, width, source)
    if np.ptp(mask, axis=2).max(initial=0.0) > _MOST_COLOUR:
        raise InputError("it has colours; expected one channel, or three equal ones: the weight of each pixel")
    mask = mask.mean(axis=2)
    if mask.min() < 0 or mask.max() > 1:
        raise InputError(f"expected values from 0 to 1, got {mask.min():g} to {mask.max():g}")
    if not mask.any():
        raise InputError("it is 0 everywhere, so no pixel would count")
    return mask, notices


def _unscaled(source: Any) -> tuple[np.ndarray, list[str]]:
    """Return the values of a mask, (H, W, C), and notices. The values are the image's alpha, unless that is nearly constant above 0.

    Raises `InputError` for ones in 8 or 16 bits, which are 1/255 or 1/65535.
    """
    image = images.read(source, linearise=False, alpha=True)
    values, notices = image.values, list[str]()
    if image.alpha is not None and not image.alpha.min() > (1 - _MOST_COLOUR) * image.alpha.max():
        values, notices = image.alpha[..., None], ["is the alpha of the image"]
    if any(np.isclose(values.max() * white, 1.0) for white in _WHITES):
        largest = "expected 1 where a pixel counts, which is 255 in 8 bits and 65535 in 16 bits; or booleans"
        raise InputError(f"its largest value is {values.max():.2g}: {largest}")
    return values, notices


def _saturated(reference: np.ndarray, counted: np.ndarray | None) -> float:
    """Return the fraction of pixels with a white channel, among those that count; None for all."""
    white = np.any(reference >= 1, axis=2)
    return float(np.mean(white if counted is None else white[counted]))


def _check_size(values: np.ndarray | StoredPicture, height: int, width: int, source: Any) -> None:
    if values.shape[:2] != (height, width):
        name = f"{Path(source).name}: " if isinstance(source, (str, Path)) else ""
        raise InputError(
            f"{name}{values.shape[1]}x{values.shape[0]} pixels (width x height), but the sensor's film is {width}x{height}"
        )


def _stored(view: View, store: PictureStore) -> View:
    stored = {name: store.add(x) for name in ("reference", "mask") if isinstance(x := getattr(view, name), np.ndarray)}
    return replace(view, **stored)
