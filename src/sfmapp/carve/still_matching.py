"""A background that stands still as one photograph shows it: moved by a pixel or so, in the light of that moment.

Lamps flicker, exposures differ and a tripod is touched: gains that change linearly over the picture and a shift are
found by least squares on the edges of the picture, where the object is not (Lucas and Kanade, 1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
Array = NDArray[np.float64]

# the band along the edges that gains and the shift are found on, of the shorter side, and every so manieth pixel of it
_BAND, _EVERY = 0.08, 2
_ROUNDS = 3
_LARGEST_SHIFT_PX = 8.0
# a pixel shows the background within so many standard deviations
_FITS = 2.5
# a shift that is off by so many pixels adds to the noise where there are edges
_SHIFT_SIGMA = 0.15
# a shadow leaves these shares of the light over a window of this side, pixels; the picture of the background may have
# a shadow itself
_LEAST_SHADE, _MOST_SHADE, _WINDOW = 0.5, 1.6, 7
# squares of deviations are believed up to this
_FARTHEST = 64.0
# of the edges of the picture, so much has to fit
_LEAST_FIT = 0.5
# and what is fine in them, against this many pixels, has to correlate, where it has so much contrast, levels
_COARSE_PX, _ALIKE, _CONTRAST = 15.0, 0.6, 3.0
# levels of noise in small pictures, at least and at most: with more, the background is another one
_LEAST_NOISE, _MOST_NOISE = 1.0, 8.0
_NORMAL = 1.5 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Matched:
    """A background (h, w, 3) as a photograph shows it where it hides nothing.

    Attributes:
        expected: (h, w, 3) float32. light: (h, w, 3) gains that made it so. shift: (2,) pixels to the right and down.
    """

    expected: Picture
    light: Picture
    shift: Array

    def away(self, color: Picture, sigma: Picture) -> Picture:
        """(h, w) mean squared deviations in units of sigma, over 3x3 pixels."""
        import cv2

        return np.asarray(cv2.blur((((color - self.expected) / sigma[..., None]) ** 2).mean(axis=-1), (3, 3)))

    def fits(self, color: Picture, sigma: Picture) -> Mask:
        """(h, w) where a photograph shows the background, or a shadow on it."""
        return np.asarray((self.away(color, sigma) < _FITS**2) | self._shade(color, sigma)[1])

    def density(self, color: Picture, sigma: Picture) -> Picture:
        """(h, w) logarithm of the density of the photograph's colours if they are the background's."""
        square = np.minimum(((color - self.expected) ** 2).sum(axis=-1) / sigma**2, _FARTHEST)
        return np.asarray(-0.5 * square - 3.0 * np.log(sigma) - _NORMAL, np.float32)

    def shaded_density(self, color: Picture, sigma: Picture) -> Picture:
        """The same of a shadow on the background: all around is darker by the same share."""
        shade, is_shaded = self._shade(color, sigma)
        density = Matched(shade[..., None] * self.expected, self.light, self.shift).density(color, 1.2 * sigma)
        return np.asarray(np.where(is_shaded, density, -40.0), np.float32)

    def is_there(self, color: Picture, sigma: Picture) -> bool:
        """Whether the photograph shows the background along its edges, and what is fine in it."""
        band = edge_band(sigma.shape)
        fine, expected = _fine(color)[band], _fine(self.expected)[band]
        contrast = float(np.linalg.norm(expected)) / np.sqrt(expected.size)
        likeness = float((fine * expected).sum() / max(np.linalg.norm(fine) * np.linalg.norm(expected), 1e-6))
        looks_alike = contrast < _CONTRAST or likeness > _ALIKE
        return bool(looks_alike and self.fits(color, sigma)[band].mean() > _LEAST_FIT)

    def _shade(self, color: Picture, sigma: Picture) -> tuple[Picture, Mask]:
        """(h, w) share of the light that is left, and whether a window looks like the background in that light."""
        import cv2

        window = (_WINDOW, _WINDOW)
        both = cv2.blur((color * self.expected).sum(axis=-1), window)
        own = cv2.blur((self.expected**2).sum(axis=-1), window) + np.float32(1.0)
        shade = both / own
        rest = (cv2.blur((color**2).sum(axis=-1), window) - shade * both) / (3.0 * cv2.blur(sigma**2, window))
        return shade, (shade > _LEAST_SHADE) & (shade < _MOST_SHADE) & (rest < _FITS**2)


def matched(color: Picture, background: Picture) -> Matched:
    """A background (h, w, 3) moved and lit as a photograph (h, w, 3) shows it along its edges."""
    basis = _basis(background.shape)
    gains, shift = np.outer(np.ones(3), [1.0, 0.0, 0.0]), np.zeros(2)
    where = np.zeros(background.shape[:2], bool)
    where[::_EVERY, ::_EVERY] = edge_band(background.shape)[::_EVERY, ::_EVERY]
    for _ in range(_ROUNDS):
        light = _light(basis, gains)
        moved = moved_by(background, shift)
        expected = moved * light
        rest = (color - expected)[where]
        largest = np.abs(rest).max(axis=1)
        is_near = largest < 4.0 * 1.4826 * np.median(largest) + 3.0
        across, down = _slopes(expected)
        normal, right = np.zeros((11, 11)), np.zeros(11)
        for channel in range(3):
            rows = np.zeros((np.count_nonzero(is_near), 11))
            rows[:, 3 * channel : 3 * channel + 3] = basis[where][is_near] * moved[where][is_near][:, [channel]]
            rows[:, 9], rows[:, 10] = -across[where][is_near][:, channel], -down[where][is_near][:, channel]
            normal += rows.T @ rows
            right += rows.T @ rest[is_near][:, channel]
        # where there is nothing to tell a shift, or a change of light over the picture, there is none
        step = np.linalg.solve(normal + 1e-6 * np.trace(normal) * np.eye(11), right)
        gains, shift = gains + step[:9].reshape(3, 3), np.clip(shift + step[9:], -_LARGEST_SHIFT_PX, _LARGEST_SHIFT_PX)
    light = _light(basis, gains)
    return Matched(np.asarray(moved_by(background, shift) * light, np.float32), light, shift)


def measured_sigma(colors: list[Picture], matches: list[Matched], background: Picture) -> Picture:
    """(h, w) standard deviation of the background: noise, by the edges of the pictures, and what a shift leaves."""
    import cv2

    band = edge_band(background.shape)
    rest = [np.median(np.abs(c - m.expected)[band]) for c, m in zip(colors, matches, strict=True)]
    noise = np.clip(1.4826 * float(np.median(rest)), _LEAST_NOISE, _MOST_NOISE)
    across, down = _slopes(background)
    slope = cv2.dilate((across**2 + down**2).max(axis=-1), np.ones((3, 3), np.uint8))
    return np.asarray(np.sqrt(noise**2 + _SHIFT_SIGMA**2 * slope), np.float32)


def put_back(color: Picture, match: Matched) -> Picture:
    """A photograph (h, w, 3) where the background is, in its light."""
    return moved_by(np.asarray(color / np.maximum(match.light, 0.05), np.float32), -match.shift)


def moved_by(values: Picture, shift: Array) -> Picture:
    """Pixels moved to the right and down, those beyond the edges the nearest ones."""
    import cv2

    move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = values.shape[1::-1]
    moved = cv2.warpAffine(values, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


def _basis(shape: tuple[int, ...]) -> Picture:
    """(h, w, 3) one, and places from left to right and top to bottom, from -1/2 to 1/2."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([np.ones(shape[:2]), x / shape[1] - 0.5, y / shape[0] - 0.5], axis=-1).astype(np.float32)


def _light(basis: Picture, gains: Array) -> Picture:
    return np.asarray(basis @ gains.T, np.float32)


def _fine(picture: Picture) -> Picture:
    import cv2

    return np.asarray(picture - cv2.GaussianBlur(picture, (0, 0), _COARSE_PX), np.float32)


def _slopes(picture: Picture) -> tuple[Picture, Picture]:
    import cv2

    return cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.125)


def edge_band(shape: tuple[int, ...]) -> Mask:
    """(h, w) the band along the edges of a picture, where the object hardly is."""
    width = max(2, round(_BAND * min(shape[:2])))
    band = np.ones(shape[:2], bool)
    band[width:-width, width:-width] = False
    return band
