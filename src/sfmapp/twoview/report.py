"""What the story of two photographs says, step by step. Matrices are rows of numbers; where a step did not come about,
its field is None, and ``ended`` says why."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report

Matrix = Sequence[Sequence[float]]


class KeypointsStep(Report):
    """Keypoints of one photograph.

    Attributes:
        median_scale_px: half of them are larger.
    """

    name: str
    width: int
    height: int
    num_keypoints: int
    median_scale_px: float


class NeighborsStep(Report):
    """Nearest neighbours among the descriptors.

    Attributes:
        num_nearest: keypoints of photograph 1 with a nearest neighbour in 2, right or wrong.
        num_after_ratio: of these, the second nearest is far enough away.
        num_mutual: of these, each is the other's nearest, and the same holds from the other side.
        max_ratio, max_distance: what was asked.
    """

    num_nearest: int
    num_after_ratio: int
    num_mutual: int
    max_ratio: float
    max_distance: float


class Improvement(Report):
    """A sample of RANSAC that beat all before it, and how many trials so many inliers ask for."""

    trial: int
    num_inliers: int
    needed: float


class RansacStep(Report):
    """RANSAC as it was written down beside the estimate of the main path.

    Attributes:
        threshold_px: Sampson distance of an inlier.
        num_matches, num_inliers, num_trials: that it was given, found, and drew.
        needed: trials for a clean sample with 99 per cent, at the share of inliers that was found.
        improvements: sample by sample.
        num_main_inliers: of the same matches, those that F of the main path (MAGSAC++) explains.
        num_common: that both explain.
        rms_px, rms_main_px: Sampson distances of those, under each.
    """

    threshold_px: float
    num_matches: int
    num_inliers: int
    num_trials: int
    needed: float
    improvements: Sequence[Improvement]
    num_main_inliers: int
    num_common: int
    rms_px: float
    rms_main_px: float


class EightPointStep(Report):
    """The eight-point algorithm on the inliers, with normalised points and without.

    Attributes:
        fundamental: of the normalised, rank two, unit norm.
        condition, condition_raw: of the system in nine unknowns, with normalisation and without.
        singular_values: of the normalised system.
        smallest_share: of F before rank two was enforced, its third singular value over its first.
        rms_px, rms_raw_px, rms_refined_px: Sampson distances with, without, and after refinement of seven unknowns.
        median_line_gap_px: how far lines of the raw F run from those of the refined one, at the matches.
        sigma_px: of a coordinate, as the residuals tell.
        num_free: independent F that fit within it; 1 if the points tell F.
    """

    num_points: int
    fundamental: Matrix
    condition: float
    condition_raw: float
    singular_values: Sequence[float]
    smallest_share: float
    rms_px: float
    rms_raw_px: float
    rms_refined_px: float
    median_line_gap_px: float
    sigma_px: float
    num_free: int


class EpipolesStep(Report):
    """Where each camera sees the other one.

    Attributes:
        first, second: pixels in photograph 1 and 2, None at infinity.
        is_inside: whether they lie in the picture.
    """

    first: Sequence[float] | None
    second: Sequence[float] | None
    is_inside: Sequence[bool]


class EssentialStep(Report):
    """E from F and the calibration, and E of the main path.

    Attributes:
        k1, k2: calibration matrices. focal_sources: where their focal lengths come from; ``photographs``: from F.
        focal_sigmas_px: of these, None where nothing is known.
        singular_values: of ``K2^T F K1`` over the first: 1, 1, 0 if F and K fit.
        essential: nearest with (1, 1, 0), unit norm.
        refined: after refinement of five unknowns on the inliers; rms_px: of it, in pixels.
    """

    k1: Matrix
    k2: Matrix
    focal_sources: Sequence[str]
    focal_sigmas_px: Sequence[float | None]
    singular_values: Sequence[float]
    essential: Matrix
    refined: Matrix
    rms_px: float


class PoseStep(Report):
    """One of the four poses: x2 = R x1 + t, and the points that are in front of both cameras under it.

    Attributes:
        votes: of them, those whose parallax is beyond the noise.
    """

    rotation: Matrix
    angle_deg: float
    translation: Sequence[float]
    num_in_front: int
    votes: int


class ChoiceStep(Report):
    """Which of the four it is.

    Attributes:
        best: position of the one with most votes. reason: why the points cannot tell; empty where they can.
        median_parallax_deg: under the best, of points in front. parallax_counts: points between ``parallax_edges_deg``.
        rotation_sigma_deg, translation_sigma_deg: of the best pose with the calibration taken for true, None where it
            is open.
        is_focal_a_guess: the calibration has a focal length that nothing is known of.
    """

    poses: Sequence[PoseStep]
    best: int
    reason: str
    num_points: int
    median_parallax_deg: float
    parallax_edges_deg: Sequence[float]
    parallax_counts: Sequence[int]
    rotation_sigma_deg: float | None
    translation_sigma_deg: float | None
    is_focal_a_guess: bool


class TriangulationStep(Report):
    """One way to triangulate.

    Attributes:
        rms_px: reprojection error over both photographs.
        median_gap_sigmas: from the points of least reprojection error, in their standard deviations.
    """

    method: str
    num_in_front: int
    rms_px: float
    median_gap_sigmas: float


class PlaneMotion(Report):
    """A motion that H allows, with the plane's normal in the frame of camera 1."""

    angle_deg: float
    translation: Sequence[float]
    normal: Sequence[float]
    is_possible: bool


class HomographyStep(Report):
    """H beside F.

    Attributes:
        num_matches: verified ones, of which H explains ``num_inliers``.
        share: of them; above ``max_share`` the pair counts as a plane or a rotation.
        rms_px: transfer error of the inliers.
        motions: four, of which the points leave two as a rule.
        gric_f, gric_h: Torr's geometric robust information criterion; the smaller is the better model.
    """

    homography: Matrix
    num_matches: int
    num_inliers: int
    share: float
    max_share: float
    rms_px: float
    motions: Sequence[PlaneMotion]
    gric_f: float
    gric_h: float


class PlaneNormal(Report):
    """A way in which the camera may have moved, as the homography of a plane alone allows it.

    Attributes:
        normal: of the plane in the frame of camera 1.
        turn_gap_deg, baseline_gap_deg: of the motion from that of the chosen pose.
    """

    normal: Sequence[float]
    turn_gap_deg: float
    baseline_gap_deg: float


class PlaneStep(Report):
    """A plane of the scene.

    Attributes:
        name: a letter. look: how it looks if the camera was held upright.
        num_matches, share: of the verified ones, within ``threshold_px`` of one homography.
        normal, normal_sigma_deg: in the frame of camera 1, away from it, under the chosen pose.
        distance, distance_sigma: of camera 1, in baselines; all four None where the matches leave it open.
        rms_px: of those matches in photograph 2.
        alternatives: what its homography alone allows; one of them is near the chosen pose where that is right.
        area_shares: of photograph 1 and 2, where most matches are on it.
    """

    name: str
    look: str
    num_matches: int
    share: float
    threshold_px: float
    normal: Sequence[float] | None
    normal_sigma_deg: float | None
    distance: float | None
    distance_sigma: float | None
    rms_px: float
    alternatives: Sequence[PlaneNormal]
    area_shares: Sequence[float]


class StartStep(Report):
    """Whether the mapper would begin a model with this pair, as its own function says.

    Attributes:
        num_points: that triangulate in front of both cameras; min_points: wanted.
        median_angle_deg: of those; min_angle_deg: wanted.
        reason: what speaks against it with these thresholds; empty if nothing.
        fallback: what it would do if no pair reached them.
    """

    would_begin: bool
    num_points: int
    min_points: int
    median_angle_deg: float
    min_angle_deg: float
    score: float
    reason: str
    fallback: str


class StoryReport(Report):
    """The story of two photographs.

    Attributes:
        kind: ``general``, ``forward``, ``plane``, ``rotation``, ``watermark``, ``identical`` or ``unknown``.
        kind_reason: in words.
        config: what the main path calls it.
        num_verified: matches that the main path verified.
        ended: why the story ends before its end; empty if it does not.
    """

    keypoints: Sequence[KeypointsStep]
    neighbors: NeighborsStep | None
    ransac: RansacStep | None
    eight_point: EightPointStep | None
    epipoles: EpipolesStep | None
    essential: EssentialStep | None
    choice: ChoiceStep | None
    triangulation: Sequence[TriangulationStep]
    homography: HomographyStep | None
    planes: Sequence[PlaneStep]
    start: StartStep | None
    kind: str
    kind_reason: str
    config: str
    num_verified: int
    ended: str
