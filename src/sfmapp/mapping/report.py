"""What mapping has brought: models, how sure they are, and what became of every image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustReport
from sfmapp.contradictions import Contradiction
from sfmapp.reporting import Report
from sfmapp.scene.reconstruction import ModelSummary


class TracksReport(Report):
    """The tracks that verified matches were joined to; ``num_conflicting_matches`` were refused."""

    num_tracks: int
    num_observations: int
    mean_track_length: float
    num_conflicting_matches: int


class AgreeingObservations(Report):
    """Observations that agree with the models that came of the focal lengths as they were given, and without them."""

    as_given: int
    as_unknown: int


class FocalReport(Report):
    """How the first focal lengths were found, and what became of those that were given.

    Attributes:
        num_pairs: pairs that were asked for a first focal length; absent where none was to be estimated.
        ratio: the likeliest focal length, a multiple of the longer side.
        loss, loss_at_default: negative logarithms of its likelihood and that of the default.
        doubted_cameras: cameras that mapping was repeated for without their focal lengths; absent without.
        agreeing_observations: what came of that.
        kept: which of the two.
    """

    num_pairs: int | None = None
    ratio: float | None = None
    loss: float | None = None
    loss_at_default: float | None = None
    doubted_cameras: Sequence[int] | None = None
    agreeing_observations: AgreeingObservations | None = None
    kept: Literal["as_given", "as_unknown"] | None = None


# Pairs that are named; the numbers count all.
NUM_NAMED = 5
# Two shared images hold the similarity of two submaps, the third one tells whether it is right.
MIN_SHARED = 3


class NamedPair(Report):
    """A verified pair of images; ``num_agreeing``: matches that agree with the model, ``num_shared_points``: those that
    are points of it."""

    images: Sequence[str]
    num_matches: int
    num_agreeing: int | None = None
    num_shared_points: int | None = None


def named_pairs(
    image_names: Sequence[str], image_idx: NDArray[np.integer], num_matches: NDArray[np.integer]
) -> list[NamedPair]:
    """Those of pairs (P, 2) that have most verified matches (P,), and of as many those that come first."""
    order = np.argsort(-num_matches, kind="stable")[:NUM_NAMED]
    return [NamedPair(images=[image_names[i] for i in image_idx[k]], num_matches=int(num_matches[k])) for k in order]


class NearPair(Report):
    """A pair of images side by side: points that both should see, and those that they do."""

    images: Sequence[str]
    num_visible: int
    num_shared: int


class LookAlikesReport(Report):
    """Parts that look alike; empty where no verified pair stood against the first map.

    Attributes:
        num_pairs_dropped, num_matches_dropped: pairs, and their verified matches, that the map was made without.
        num_matches_against_before, num_matches_against: verified matches that contradict the first map, and this one.
        pairs: the strongest of those that were dropped.
    """

    num_pairs_dropped: int | None = None
    num_matches_dropped: int | None = None
    num_matches_against_before: int | None = None
    num_matches_against: int | None = None
    pairs: Sequence[NamedPair] | None = None


class InitialPairReport(Report):
    """A pair that a model was to start from; ``reason``: what spoke against it, empty if nothing."""

    images: Sequence[str]
    num_matches: int
    num_points: int
    median_angle_deg: float
    reason: str


class StartReport(Report):
    """The pairs that one model was tried to start from, in this order."""

    pairs: Sequence[InitialPairReport]


class MappedImage(Report):
    """What became of an image.

    Attributes:
        model: position of the model that holds it; None for none.
        reason: why none does; empty if one does.
        num_observations: of points of its model.
        num_correspondences, num_pose_inliers: points that the last attempt to register it met, and those that agreed
            with its pose; absent if there was none.
    """

    name: str
    model: int | None
    reason: str
    num_observations: int
    num_correspondences: int | None = None
    num_pose_inliers: int | None = None


class FocalEvidence(Report):
    """What the photographs tell of a focal length; empty where no uncertainty is known.

    Attributes:
        data_sigma_px: standard deviation by the photographs alone; absent: they do not tell it.
        prior_sigma_px: that of what was known before.
        is_determined: they tell more than was known.
        is_prior_left_out: they refute what was known.
        photographs_px: focal length by the photographs alone, where there was doubt about it.
        tension: how far that is from what was known, in standard deviations of both.
    """

    data_sigma_px: float | None = None
    prior_sigma_px: float | None = None
    is_determined: bool | None = None
    is_prior_left_out: bool | None = None
    photographs_px: float | None = None
    tension: float | None = None


class CameraSigmas(Report):
    """How sure the parameters of a camera are.

    Attributes:
        camera: its position.
        sigma: standard deviations by name of the parameter, of those that were free.
        focal: what the photographs tell of its focal length.
    """

    camera: int
    sigma: Mapping[str, float]
    focal: FocalEvidence | None = None


class ImageSigmas(Report):
    """Standard deviations of a pose: of the centre along each axis as a share of the model's size, and in degrees."""

    center_sigma_share: float
    rotation_sigma_deg: float


class Uncertainty(Report):
    """How sure a model is; empty where that could not be had.

    Attributes:
        noise_px: standard deviation of the keypoints, by the residuals.
        cameras: those with free parameters.
        median_center_sigma_share, worst_center_sigma_share: standard deviations of the centres along each axis, as
            shares of the largest distance of a centre from their middle.
        median_rotation_sigma_deg: of the rotations about each axis.
        images: by name.
        images_left_open: those whose observations do not tell their poses, which are not among ``images``.
        closing_move_sigmas: how far the closing adjustments moved the cameras, rms, in the standard deviations that the
            residuals alone give; where it is above 2.5, all of these have grown by what is more.
    """

    noise_px: float | None = None
    cameras: Sequence[CameraSigmas] | None = None
    median_center_sigma_share: float | None = None
    worst_center_sigma_share: float | None = None
    median_rotation_sigma_deg: float | None = None
    images: Mapping[str, ImageSigmas] | None = None
    images_left_open: Sequence[str] = ()
    closing_move_sigmas: float | None = None


class ModelEntry(ModelSummary):
    """A model; ``apart``: why it is not one with another, empty if there is no reason."""

    contradictions: Sequence[Contradiction]
    apart: str


class ModelReport(ModelEntry):
    """A model, how sure it is, and the last of its closing adjustments."""

    uncertainty: Uncertainty
    adjustment: AdjustReport | None = None


class SubmapReport(Report):
    """A model of one part of the images; ``reason``: why it is not in that of all, empty if it is."""

    first_image: str
    num_images: int
    num_images_of_part: int
    reason: str


class SeamReport(Report):
    """How two submaps agree that share images.

    Attributes:
        submaps: their positions.
        num_images, num_elsewhere: those that both hold, and of these such as they put at different places.
        num_points, num_points_agreeing: points of the one that images of the other alone see, and those that are where
            these see them.
        sigmas: rms of what both say differently, in standard deviations of both; absent where that was not come to.
        reason: why they were not joined by it; empty if they were.
    """

    submaps: Sequence[int]
    num_images: int
    num_elsewhere: int
    num_points: int
    num_points_agreeing: int
    sigmas: float | None
    reason: str


class FailedPartReport(Report):
    """A part of the images that came to no model: they are registered from where their neighbours are."""

    first_image: str
    num_images: int
    reason: str


class PartsReport(Report):
    """A set of images that was mapped in parts; empty where it was mapped as a whole from the first.

    Attributes:
        given_up: why it was mapped as a whole after all; empty if it was not.
    """

    submaps: Sequence[SubmapReport] | None = None
    seams: Sequence[SeamReport] | None = None
    failed: Sequence[FailedPartReport] | None = None
    given_up: str = ""


class MappingReport(Report):
    """What the stage ``mapping`` did; the largest model comes first."""

    tracks: TracksReport
    focal: FocalReport
    look_alikes: LookAlikesReport
    initial_pairs: Sequence[StartReport]
    parts: PartsReport = field(default_factory=PartsReport)
    images: Sequence[MappedImage]
    models: Sequence[ModelReport]
