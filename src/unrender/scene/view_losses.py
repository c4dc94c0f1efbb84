"""Losses of views, and references and masks on the device."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.losses import Censored, Loss
from unrender.losses.pixelwise import determined_pixels
from unrender.rendering.renderer import Renderer
from unrender.scene.references import References
from unrender.scene.view import View


class ViewLosses:
    """The part of `Problem` that estimators use: a loss per view. The attributes are those of `Problem`."""

    loss: Loss
    views: tuple[View, ...]
    original_views: tuple[View, ...]
    renderer: Renderer
    references: References
    _references: dict[int, Array]
    _masks: dict[int, Array | None]

    @property
    def given_views(self) -> tuple[View, ...]:
        """Former name of `original_views`. Version 0.2 removes it."""
        warnings.warn("Problem.given_views is now Problem.original_views", DeprecationWarning, stacklevel=2)
        return self.original_views

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of each view."""
        known = self.renderer.resolutions()
        return [known[view.sensor] for view in self.views]

    def reference(self, view: int) -> Array:
        """Return the view's reference as an array of the renderer, (H, W, 3)."""
        if view in self._references:
            return self._references[view]
        array = self.renderer.array(np.asarray(self.views[view].reference))
        if not self.references.in_host_memory:
            self._references[view] = array
        return array

    def mask(self, view: int) -> Array | None:
        """Return the view's mask as an array of the renderer, (H, W, 1), or None if every pixel counts."""
        if view in self._masks:
            return self._masks[view]
        mask = self.views[view].mask
        array = None if mask is None else self.renderer.array(np.asarray(mask)[..., None])
        if not self.references.in_host_memory:
            self._masks[view] = array
        return array

    def test_weights(self, view: int, images: Sequence[np.ndarray] = ()) -> np.ndarray:
        """Return the weight (H, W) of each pixel in tests of pictures: the mask's, and 0 for lower bounds of `Censored`.

        Bounds that independent images (H, W, 3) do not reach have the mask's weight, since these images are wrong there.
        """
        weights = self.views[view].pixel_weights(self.sizes[view])
        if not isinstance(self.loss, Censored):
            return weights
        return weights * determined_pixels(
            self.loss, np.asarray(self.views[view].reference), np.asarray(images) if len(images) else None
        )

    def loss_value(self, view: int, image: Array) -> Array:
        """Return the view's loss at an image (H, W, 3): weight * mean(mask * loss), a lazy scalar."""
        return arrays.mean(self._values(image, self.reference(view), self.mask(view))) * self.views[view].weight

    def loss_values(self, view: int, images: Array) -> Array:
        """Return `loss_value` of each of B images (B, H, W, 3): (B,), lazy."""
        reference, mask = arrays.add_first_axis(self.reference(view)), self.mask(view)
        values = self._values(images, reference, None if mask is None else arrays.add_first_axis(mask))
        return arrays.mean_over_rest(values) * self.views[view].weight

    def loss_derivative(self, view: int, image: Array) -> Array:
        """Return ∂(total loss)/∂(pixel) at an image (H, W, 3): weight * mask * loss' / (H * W * 3)."""
        reference, mask = self.reference(view), self.mask(view)
        derivative = self.loss.derivative(self._masked(image, reference, mask), reference)
        factor = self.views[view].weight / math.prod(arrays.shape(reference))
        return (derivative if mask is None else derivative * mask) * factor

    def _values(self, image: Array, reference: Array, mask: Array | None) -> Array:
        values = self.loss.value(self._masked(image, reference, mask), reference)
        return values if mask is None or not self.loss.pixelwise else values * mask

    def _masked(self, image: Array, reference: Array, mask: Array | None) -> Array:
        """Return the argument of the loss: the image for a pixelwise loss, else the reference and image blended by the mask."""
        return image if mask is None or self.loss.pixelwise else reference + mask * (image - reference)
