"""Shadows in a photograph under one light, found against the same photograph lit from the camera.

Both show the same pixels of the same surface, so their quotient is free of its colour: ``g (n l) / (n c)`` where the
light l falls, n being the surface's normal, c the camera's direction, g the quotient of the lights' powers; 0 in the
shadow. What leans towards the light enough for :mod:`sfmapp.carve.shadow_carving` to tell is brighter than
``g sin(fan) / sin(angle + fan)``. Dark is what stays below a share of that, whatever noise has done to both pictures;
the darker a shadow is, the narrower is the fan for which it does.

A surface that is turned away from the light is as dark as one in the shadow of another, but of an edge between one that
only the camera sees and one that only the light falls on it says nothing. Where light and camera are farther apart than
the sharpest edge, dark is therefore only what certainly leans towards the light, by :mod:`sfmapp.carve.leaning`.

Where the quotient says nothing, nothing is called dark: surfaces that are very dark themselves, where noise alone is as
bright as what is asked for; and surfaces that mirror, which may look dark though they are lit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label, maximum_filter, uniform_filter

from sfmapp.carve.leaning import Quotients, lamp_gains, leans_towards, quotients_of
from sfmapp.carve.octree import Octree, places_of
from sfmapp.carve.views import View, angle_deg
from sfmapp.reporting import Report

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Most = NDArray[np.float32]
Fans = NDArray[np.float32]
Array = NDArray[np.float64]
Levels = NDArray[np.float64]

# standard deviations by which means of 3 x 3 pixels may be off: of a hundred thousand three; and by which the pixel may
# be off itself, for which half of the least brightness is left as well
_CERTAIN, _PIXEL = 4.0, 1.0
# of the least brightness of a lit surface what a shadow may have: light falls off with distance within the object, and
# is sent on by its other parts
_SHARE = 0.5
# shares of an object's pixels that cannot be told, from which it is said
_NOTEWORTHY = 0.05
# grey levels from which a picture says only that there was more light
_FULL = 252
# pixels about a mirrored light where its image may still outshine the surface, in its radii, and at least
_HALO, _LEAST_HALO_PX = 2.0, 4
# pixels that touch each other and are dark, fewer than which may be dead ones
_SPECK = 4
# quotient of a picture under a light, against that of the brightest tenth, from which the surface counts as lit
_LIT = 0.25


class DetectionReport(Report):
    """What could be told of shadows in the photographs of one light.

    Attributes:
        light: its name.
        gain: typical quotient of a photograph under it and the one that is lit from the camera, in linear brightness.
        noise_grey: standard deviation of the noise, grey levels.
        dark_share: of the object's pixels, in shadow that something throws.
        turned_share: as dark, but the surface may be turned away from the light.
        too_dark_share: of surfaces too dark to be told.
        mirror_share: about the mirrored images of lights.
    """

    light: str
    gain: float
    noise_grey: float
    dark_share: float
    turned_share: float
    too_dark_share: float
    mirror_share: float


@dataclass(frozen=True)
class LitPhotograph:
    """A photograph lit from the camera, and those under lights, from the same place.

    Attributes:
        lit: (H, W) uint8, or (H, W, 3).
        under: as many of the same shape as there are lights.
        inside: (H, W) bool pixels that show nothing but the object.
        view: their camera. lamps: (3,) places of the lights, world. hull: that holds the object.
    """

    lit: Picture
    under: Sequence[Picture]
    inside: Mask
    view: View
    lamps: Sequence[Array]
    hull: Octree

    @property
    def angles_deg(self) -> list[float]:
        """Between camera and each light, as seen from the object."""
        middle = self.hull.low + self.hull.cell * (places_of(self.hull.surface).mean(axis=0) + 0.5)
        return [angle_deg(middle, self.view, lamp) for lamp in self.lamps]


def find_shadows(
    photographs: Sequence[LitPhotograph], names: Sequence[str], *, fan_deg: float, edge_deg: float
) -> tuple[list[list[Fans]], list[Most], list[DetectionReport]]:
    """How certainly pixels are in shadow.

    Args:
        photographs: of one camera from different places, each under the same lights, exposed alike; grey values are
            those of sRGB.
        names: of the lights.
        fan_deg, edge_deg: as in :class:`~sfmapp.carve.shadow_carving.ShadowOptions`.

    Returns:
        for each photograph and light fans (H, W) as in :class:`~sfmapp.carve.shadow_carving.Shadow`; for each
        photograph (L, H, W) as in :class:`~sfmapp.carve.lamp_mixtures.LampLight`; and a report for each light.
    """
    num = len(names)
    sigmas = [noise_of([p.under[k] for p in photographs]) for k in range(num)]
    sigma_lit = noise_of([p.lit for p in photographs])
    gains = [_gain(photographs, k) for k in range(num)]
    # made twice, as those of all photographs together would take much memory
    told = lamp_gains((_quotients(photograph) for photograph in photographs), np.maximum(gains, 1e-6))
    counts = np.zeros((num, 5))
    fans: list[list[Fans]] = []
    lights: list[Most] = []
    for photograph in photographs:
        inside, angles, quotients = photograph.inside, photograph.angles_deg, _quotients(photograph)
        least = linear(_mean(photograph.lit) - _CERTAIN / 3.0 * sigma_lit)
        mirrors = _mirrors(photograph) & inside
        fans.append([])
        lights.append(np.full((num, *inside.shape), np.inf, np.float32))
        for k, (sigma, gain) in enumerate(zip(sigmas, gains, strict=True)):
            full = _SHARE * gain * least
            limit = full * quotient_of_lean(angles[k], fan_deg)
            # what no light at all may look like
            too_dark = inside & (limit <= linear(np.array(_CERTAIN / 3.0 * sigma)))
            grey = _grey(photograph.under[k])
            shown = np.maximum(_mean(photograph.under[k]) + _CERTAIN / 3.0 * sigma, grey + _PIXEL * sigma)
            # beside a lit place, what is dark is so by itself
            shown = linear(np.minimum(shown, grey + _CERTAIN * sigma))
            seen = _without_specks((shown < limit) & inside & ~too_dark & ~mirrors)
            # nothing by lamps whose power is not known
            usable = inside & ~mirrors & (told[k] * least > 0.0)
            most = np.where(usable, shown / np.where(usable, told[k] * least, 1.0), np.inf)
            # a pixel beside may show what the middle of a cell does not
            lights[-1][k] = maximum_filter(most, 3)
            dark = seen if angles[k] <= edge_deg else leans_towards(quotients, told, k, seen)
            fan = fan_of_quotient(shown / np.where(dark, full, 1.0), angles[k])
            fans[-1].append(np.where(dark, fan, np.inf).astype(np.float32))
            counts[k] += [mask.sum() for mask in (inside, dark, seen & ~dark, too_dark, mirrors)]
    shares = counts[:, 1:] / np.maximum(counts[:, :1], 1.0)
    reports = [
        DetectionReport(light=name, gain=gain, noise_grey=sigma, dark_share=float(row[0]), turned_share=float(row[1]),
                        too_dark_share=float(row[2]), mirror_share=float(row[3]))
        for name, gain, sigma, row in zip(names, gains, sigmas, shares, strict=True)
    ]  # fmt: skip
    return fans, lights, reports


def doubts_of(reports: Sequence[DetectionReport]) -> list[str]:
    """What has to be said of surfaces whose shadows cannot be told, in sentences."""
    doubts = []
    dark = max((report.too_dark_share for report in reports), default=0.0)
    mirror = max((report.mirror_share for report in reports), default=0.0)
    turned = max((report.turned_share for report in reports), default=0.0)
    if turned > max([_NOTEWORTHY, *(report.dark_share for report in reports)]):
        doubts.append(
            f"{turned:.0%} of the object is dark, but may be turned away from the light: if you know how sharp its "
            "edges are, say so (sharpest_edge_deg in the file of lights), and shadows carve more"
        )
    if dark > _NOTEWORTHY:
        doubts.append(f"{dark:.0%} of the object is too dark to tell shadows on it: nothing is carved there by shadows")
    if mirror > _NOTEWORTHY:
        doubts.append(f"{mirror:.0%} of the object mirrors its lights: nothing is carved there by shadows")
    return doubts


def _without_specks(dark: Mask) -> Mask:
    """A mask without what is smaller than some pixels."""
    pieces, _ = label(dark, np.ones((3, 3)))
    return np.asarray(dark & (np.bincount(pieces.ravel()) >= _SPECK)[pieces])


def quotient_of_lean(angle: float, fan: float) -> float:
    """Least ``(n l) / (n c)`` of a surface that is seen from the camera, and from ``fan`` degrees beyond a light at
    ``angle`` degrees from it."""
    return float(np.sin(np.radians(fan)) / np.sin(np.radians(angle + fan)))


def fan_of_quotient(quotient: Levels, angle: float) -> Levels:
    """Inverse of :func:`quotient_of_lean`: fans, degrees, of least quotients."""
    a = np.radians(angle)
    return np.asarray(np.degrees(np.arctan2(quotient * np.sin(a), 1.0 - quotient * np.cos(a))))


def linear(grey: Levels) -> Levels:
    """Brightness, 1 is white, of grey levels 0 to 255 on the curve of sRGB (IEC 61966-2-1); what is below is 0."""
    v = np.clip(grey / 255.0, 0.0, None)
    return np.asarray(np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4))


def noise_of(pictures: Sequence[Picture]) -> float:
    """Standard deviation of the noise of pictures, grey levels: of differences that steady slopes do not make
    (Immerkaer, "Fast noise variance estimation", CVIU 64, 1996), robustly, where pictures are not black or white."""
    found = []
    for picture in pictures:
        v = _grey(picture)
        difference = v[:-2, :-2] + v[2:, :-2] + v[:-2, 2:] + v[2:, 2:] + 4.0 * v[1:-1, 1:-1]
        difference -= 2.0 * (v[1:-1, :-2] + v[1:-1, 2:] + v[:-2, 1:-1] + v[2:, 1:-1])
        usable = (v[1:-1, 1:-1] > 8.0) & (v[1:-1, 1:-1] < _FULL)
        if usable.any():
            found.append(float(1.4826 * np.median(np.abs(difference[usable])) / 6.0))
    # rounding to whole levels is noise as well
    return max(float(np.median(found)) if found else 0.0, math.sqrt(1.0 / 12.0))


def _grey(picture: Picture) -> Levels:
    values = picture.astype(np.float64)
    return np.asarray(values.mean(axis=2) if values.ndim == 3 else values)


def _mean(picture: Picture) -> Levels:
    """Grey values of 3 x 3 pixels."""
    return np.asarray(uniform_filter(_grey(picture), 3, mode="nearest"))


def _gain(photographs: Sequence[LitPhotograph], k: int) -> float:
    """Quotient of brightness where a light falls, the median of what is not much darker than the brightest tenth."""
    quotients = []
    for photograph in photographs:
        lit = _grey(photograph.lit)
        usable = photograph.inside & (lit > 32.0) & (lit < _FULL)
        quotients.append(linear(_grey(photograph.under[k])[usable]) / linear(lit[usable]))
    values = np.concatenate(quotients) if quotients else np.empty(0)
    if not len(values):
        return 0.0
    return float(np.median(values[values > _LIT * np.quantile(values, 0.9)]))


def _quotients(photograph: LitPhotograph) -> Quotients:
    """Of 3 x 3 pixels, 0 where the object is black; usable where no picture is full."""
    lit = linear(_mean(photograph.lit))
    under = np.array([linear(_mean(picture)) for picture in photograph.under])
    usable = photograph.inside & ~_mirrors(photograph) & (lit > 0.0)
    quotients = np.where(usable, under / np.where(usable, lit, 1.0), 0.0)
    return quotients_of(photograph.view, photograph.lamps, photograph.hull, quotients, usable)


def _mirrors(photograph: LitPhotograph) -> Mask:
    """Pixels about the mirrored images of lights. Where what mirrors shows none, it is dark under the camera's light as
    well, and too dark to be told."""
    pictures = [_grey(photograph.lit), *map(_grey, photograph.under)]
    full = np.max(pictures, axis=0) >= _FULL
    if full.any():
        radius = max(_LEAST_HALO_PX, int(_HALO * np.sqrt(full.sum() / np.pi / max(label(full)[1], 1))))
        y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        full = binary_dilation(full, x * x + y * y <= radius * radius)
    return np.asarray(full)
