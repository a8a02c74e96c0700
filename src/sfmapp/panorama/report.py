"""What the stages of a panorama say of themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.contradictions import Contradiction
from sfmapp.reporting import NamedReason, Report


class TurnedCamera(Report):
    """A camera that turned.

    Attributes:
        prior_focal_px, prior_source: before the photographs were matched, and from what.
        start_focal_px: what pairs alone gave.
        refined: names of what the adjustment found: ``log_focal``, ``k1``, ``k2``.
        sigma: of each of these; of ``log_focal`` the relative one of the focal length.
        is_told: the photographs tell the focal length, to a twentieth or better; otherwise it hangs on the prior.
    """

    camera_idx: int
    num_images: int
    model: str
    width: int
    height: int
    prior_focal_px: float
    prior_source: str
    start_focal_px: float
    focal_px: float
    focal_sigma_px: float | None
    params: Sequence[float]
    refined: Sequence[str]
    sigma: Mapping[str, float]
    is_told: bool


class TurnedImage(Report):
    """A photograph of the panorama.

    Attributes:
        rotation: quaternion x, y, z, w of cam_from_world.
        sigma_deg: about the x, y and z axes of the camera, against the mean of all.
        num_rays: rays that it shares with others.
        rms_px: of its residuals.
    """

    name: str
    camera_idx: int
    rotation: Sequence[float]
    sigma_deg: Sequence[float]
    num_rays: int
    rms_px: float | None


class TurnedPair(Report):
    """A pair of photographs with verified matches.

    Attributes:
        images: names.
        num_matches: verified. num_turned: those that the panorama explains, within ``threshold_px``.
        turn_deg: between the two.
        median_px: of the angles between matched rays, in pixels, over all verified matches.
        parallax_px: what of that noise does not explain, neither that of the panorama nor the pair's own: 0 where the
            camera turned on the spot.
        verdict: ``rotation``, ``parallax``, ``contradicted`` or ``no rotation``.
    """

    images: tuple[str, str]
    num_matches: int
    num_turned: int
    threshold_px: float
    turn_deg: float
    median_px: float
    parallax_px: float
    verdict: str


class LensChoice(Report):
    """How well lens models predict rays that they were not fitted to.

    Attributes:
        num_distortion: coefficients that were refined. held_out_px: root of the mean robust square of each half, fitted
            to the other.
    """

    num_distortion: int
    held_out_px: Sequence[float]


class TurningReport(Report):
    """Rotations of photographs from one place.

    Attributes:
        noise_px: standard deviation of a coordinate of a keypoint.
        correlation: factor by which the standard deviations were widened, as residuals of neighbours agree.
        num_rays, num_observations: that the adjustment used.
        turned_share: of all verified matches those that the rotations explain.
        left_out: photographs that are not in the panorama.
        thresholds: the figures behind these decisions, by name.
    """

    num_images: int
    num_turned: int
    noise_px: float
    correlation: float
    num_rays: int
    num_observations: int
    turned_share: float
    cameras: Sequence[TurnedCamera]
    images: Sequence[TurnedImage]
    pairs: Sequence[TurnedPair]
    lens_choice: Sequence[LensChoice]
    left_out: Sequence[NamedReason]
    contradictions: Sequence[Contradiction]
    thresholds: Mapping[str, float]


class PictureReport(Report):
    """The picture of a panorama.

    Attributes:
        file: its name. projection: ``spherical``, ``cylindrical`` or ``planar``.
        scale: pixels of a radian in the middle.
        span_deg: of the horizon that it shows. is_closed: it goes all round.
        shown_share: of its pixels those that photographs show.
        gains: factors by name that the colours of photographs were multiplied by, red, green and blue.
        worst_overlap: largest relative difference in brightness that is left between two photographs.
    """

    file: str
    projection: str
    width: int
    height: int
    scale: float
    span_deg: float
    is_closed: bool
    shown_share: float
    gains: Mapping[str, Sequence[float]]
    worst_overlap: float
