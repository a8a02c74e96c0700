"""What a run says of itself: the objects that HTML, terminal and JSON are renderings of.

What stages say stands beside them (``mapping/report.py`` and so on); here it is put together to the report of each
command. A report answers to attributes and, as JSON has it, to keys: see :class:`~sfmapp.reporting.Report`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from sfmapp.adjust.options import AdjustReport
from sfmapp.calibration.report import BoardReport
from sfmapp.calibration.rig_report import RigReport
from sfmapp.contradictions import Contradiction
from sfmapp.dense.report import (
    CloudNumbers,
    ClusterReport,
    LevelReport,
    SeedsReport,
    SharesReport,
    TwoViewsReport,
    ViewsReport,
    WaveReport,
)
from sfmapp.errors import SfmError
from sfmapp.evaluation.report import Statistics
from sfmapp.features.report import FeaturesReport
from sfmapp.georeference.control.report import ControlReport, UnitsReport
from sfmapp.georeference.poses.report import PosesReport
from sfmapp.georeference.report import GeoreferenceReport
from sfmapp.images.report import ImagesReport
from sfmapp.mapping.report import FocalEvidence, MappingReport, ModelEntry
from sfmapp.matching.report import MatchingReport, PairsReport
from sfmapp.odometry.report import FilterReport, OdometryReport, ScaleReport
from sfmapp.report.plan import PlanCheck
from sfmapp.reporting import NamedReason, Plain, Report, Step, Usage
from sfmapp.surface.report import MeshReport
from sfmapp.video.report import VideoReport

Light = Literal["green", "amber", "red"]

# ------------------------------------------------------------------------------------------------- what all runs share


class Outcome(Report):
    """How a run ended: its exit code and, where that is not 0, why and what to do about it."""

    exit_code: int
    message: str
    advice: str | None

    @classmethod
    def of(cls, failure: SfmError | None) -> Outcome:
        """Of a failure, or of none."""
        if failure is None:
            return cls(exit_code=0, message="", advice=None)
        return cls(exit_code=failure.exit_code, message=str(failure), advice=failure.advice)


class RunUsage(Usage):
    """What a run took.

    Attributes:
        is_up_to_date: nothing had changed since an earlier run, whose results these are.
    """

    is_up_to_date: bool = False


class RunFacts(RunUsage):
    """How a run was called, and what it took.

    Attributes:
        source: what the user gave to work on.
        options: of all stages, as they were in effect.
        versions: of what a result depends on.
        started: date and time in UTC.
    """

    source: str
    seed: int
    threads: int
    options: Mapping[str, Plain]
    versions: Mapping[str, str]
    started: str


class Check(Report):
    """A traffic light over a number, with its thresholds in words."""

    name: str
    value: str
    light: Light
    thresholds: str


class LogLine(Report):
    """What was decided or warned of, seconds after the run began; ``data``: the numbers behind it."""

    time_s: float
    kind: str
    stage: str
    message: str | None = None
    data: Mapping[str, Plain] | None = None


class ProgressLine(LogLine):
    """Of a stage that begins or goes on: steps that are done, of how many in all; None where that is not known."""

    done: int
    total: int | None


# ----------------------------------------------------------------------------------------------------- reconstruction


class Funnel(Report):
    """How many of what were left of an image at each step from its keypoints to its pose; None: it did not come so far.

    Attributes:
        candidate_pairs, verified_pairs: pairs with it that were matched, and that have verified matches.
        putative_matches, verified_matches: of these pairs.
        correspondences_2d3d, pose_inliers: points of the map that it saw, and that agreed with its pose.
        observations: of points of the final model.
    """

    features: int | None
    candidate_pairs: int | None
    verified_pairs: int | None
    putative_matches: int | None
    verified_matches: int | None
    correspondences_2d3d: int | None
    pose_inliers: int | None
    observations: int | None


class Failure(Report):
    """Where an image fell out of the funnel, why, with the threshold, and what the user can do about it."""

    failed_at: str
    reason: str
    remedy: str


class ImageReport(Report):
    """What became of an image; ``failed_at``, ``reason`` and ``remedy`` of :class:`Failure` if no model holds it."""

    name: str
    is_registered: bool
    model: int | None
    funnel: Funnel
    failed_at: str | None = None
    reason: str | None = None
    remedy: str | None = None


class CameraReport(Report):
    """A camera with the parameters that it began with and those that it ended with.

    Attributes:
        initial: by name.
        refined: None if the largest model does not hold it.
        sigma: standard deviations of parameters that were free.
        focal_evidence: what the photographs tell of its focal length.
    """

    idx: int
    model: str
    width: int
    height: int
    num_images: int
    focal_source: str
    focal_sigma_px: float | None
    is_fixed: bool
    initial: Mapping[str, float]
    refined: Mapping[str, float] | None
    sigma: Mapping[str, float]
    focal_evidence: FocalEvidence


class Histogram(Report):
    """Counts of values between edges, of which there is one more; ``median`` of the values, None without any."""

    edges: Sequence[float]
    counts: Sequence[int]
    median: float | None


class DenseHistograms(Report):
    """Patches by the number of views, by score, and by deviation in pixels of the photograph on the surface."""

    views: Histogram
    score: Histogram
    sigma_px: Histogram


class CoverageReport(Report):
    """How much of a photograph patches cover.

    Attributes:
        num_patches: whose reference it is; ``num_trusting``: that trust it.
        coverage: share of its blocks that holds a patch that trusts it; ``out_of_sight``, ``plain`` and ``unmatched``
            are the shares of the others, by why they are bare.
        reason: the largest of these in words; empty where the photograph is well covered.
    """

    name: str
    num_neighbors: int
    num_patches: int
    num_trusting: int
    coverage: float
    out_of_sight: float
    plain: float
    unmatched: float
    reason: str


class DensePart(Report):
    """What the page shows of patches and mesh.

    Attributes:
        funnel: what was accepted, what each step took away, and what was left.
        images: a row for each view.
        mesh: None without.
        two_views: absent where there are more, or where stereo cannot rectify them.
    """

    num_patches: int
    num_views: int
    checks: Sequence[Check]
    seeds: SeedsReport
    levels: Sequence[LevelReport]
    waves: Sequence[WaveReport]
    funnel: Sequence[Step]
    histograms: DenseHistograms
    images: Sequence[CoverageReport]
    mesh: MeshReport | None
    two_views: TwoViewsReport | None = None


class DenseReport(CloudNumbers):
    """What densification did, as far as it came."""

    outcome: Outcome
    calibration: CalibratedModelReport | None = None
    views: ViewsReport | None = None
    clusters: Sequence[ClusterReport] = ()
    num_patches: int = 0
    levels: Sequence[LevelReport] = ()
    waves: Sequence[WaveReport] = ()
    funnel: Sequence[Step] = ()
    seeds: SeedsReport | None = None
    two_views: TwoViewsReport | None = None
    shares: SharesReport | None = None
    run: RunUsage


class MeshRunReport(MeshReport):
    """What meshing did."""

    outcome: Outcome
    run: RunUsage


class FailedReport(Report):
    """A stage that came to nothing, and why."""

    outcome: Outcome
    run: RunUsage


class Stages(Report):
    """What each stage of a reconstruction or a dense run said; absent where none was reached."""

    videos: Sequence[VideoReport] | None = None
    images: ImagesReport | None = None
    features: FeaturesReport | None = None
    pairs: PairsReport | None = None
    matching: MatchingReport | None = None
    mapping: MappingReport | None = None
    control: ControlReport | None = None
    poses: PosesReport | None = None
    units: UnitsReport | None = None
    georeference: GeoreferenceReport | None = None
    dense: DenseReport | None = None
    mesh: MeshRunReport | FailedReport | None = None


class AddedPhotograph(Report):
    """A photograph that was added; ``reason``: why it is in no model, empty where it is in ``model``."""

    name: str
    model: int | None
    reason: str


class AddedReport(Report):
    """Photographs that were added to a finished reconstruction.

    Attributes:
        source: where they are from.
        photographs: the new ones.
        known: those that were there already, and as what.
        linked: photographs that were left over before and are in the model now.
        num_pairs, num_known_pairs: that were compared, and how many of these before.
        moved_sigmas: how far the photographs of before have moved, rms, in their standard deviations; absent where
            these are not known.
    """

    source: str
    photographs: Sequence[AddedPhotograph]
    known: Sequence[NamedReason]
    linked: Sequence[str]
    num_pairs: int
    num_known_pairs: int
    moved_sigmas: float | None = None

    @property
    def text(self) -> str:
        """In words."""
        here = sum(one.model == 0 for one in self.photographs)
        text = f"{here} of {len(self.photographs)} photographs of {self.source} were added to the model"
        if self.linked:
            text += f", which links {', '.join(self.linked)} as well"
        if self.moved_sigmas is not None:
            text += f"; those of before have moved by {self.moved_sigmas:.2g} of their standard deviations"
        return text


class MergedReport(Report):
    """Two reconstructions that were made one.

    Attributes:
        first, second: their folders. num_images: photographs in the model of each. num_shared: in both.
        off_sigmas: how far the shared ones are apart once one model is moved onto the other, rms, in the standard
            deviations of both; absent where these are not known, or too few are shared.
    """

    first: str
    second: str
    num_images: Sequence[int]
    num_shared: int
    off_sigmas: float | None = None

    @property
    def text(self) -> str:
        """In words."""
        text = f"{self.first} ({self.num_images[0]} photographs) and {self.second} ({self.num_images[1]}) are one model"
        if self.off_sigmas is None:
            return f"{text}; {self.num_shared} photographs were in both"
        return (
            f"{text}; {self.num_shared} photographs were in both, {self.off_sigmas:.1f} standard deviations apart once "
            "one was moved onto the other"
        )


class ReconstructionReport(Report):
    """The report of ``sfmapp reconstruct``.

    Attributes:
        models: the largest first.
        images: what became of each.
        usage: of each stage.
        added: the photographs that were added last; absent where there were none.
        dense: patches and mesh; absent without.
        plan: what was planned beside what the run took; absent where nothing was planned, or not all was done anew.
    """

    format: str
    outcome: Outcome
    run: RunFacts
    models: Sequence[ModelEntry]
    checks: Sequence[Check]
    images: Sequence[ImageReport]
    skipped: Sequence[NamedReason]
    cameras: Sequence[CameraReport]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]
    stages: Stages
    added: AddedReport | None = None
    merged: MergedReport | None = None
    dense: DensePart | None = None
    plan: PlanCheck | None = None


class DenseRunReport(Report):
    """The report of ``sfmapp dense`` and ``sfmapp mesh`` on a model that sfmapp did not make."""

    format: str
    outcome: Outcome
    run: RunFacts
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]
    stages: Stages
    dense: DensePart | None = None


class LensChange(Report):
    """A lens of a model that a calibration replaced.

    Attributes:
        before, after: models of the lens.
        focal_px: of the calibration, at the axis.
        told_focal_px, told_sigma_px: what photographs of it tell by themselves; absent where they are few.
        rms_px, max_px: over the picture, how far both project the same rays apart, after the best turn; absent where
            they hardly see the same.
        sigma_px: standard deviation of a coordinate of that by the calibration, rms over the picture; absent where it
            does not say.
    """

    before: str
    after: str
    focal_px: float
    told_focal_px: float | None = None
    told_sigma_px: float | None = None
    rms_px: float | None = None
    max_px: float | None = None
    sigma_px: float | None = None

    @property
    def text(self) -> str:
        """In words."""
        if self.rms_px is None:
            return f"{self.before} to {self.after}, which see hardly the same; {self._told}"
        sigma = "" if self.sigma_px is None else f", sigma of the calibration {self.sigma_px:.2f}"
        apart = f"{self.rms_px:.2f} px rms apart, {self.max_px:.2f} at most{sigma}"
        return f"{self.before} to {self.after}: {apart}; {self._told}"

    @property
    def _told(self) -> str:
        if self.told_focal_px is None or self.told_sigma_px is None:
            return "the photographs cannot tell the focal length, and not contradict it"
        share = 100 * self.told_sigma_px / self.told_focal_px
        return f"the photographs can tell the focal length only to {share:.2g} %"


class CalibratedModelReport(Report):
    """A model whose lenses a calibration replaced, with poses and points adjusted to it.

    Attributes:
        file: what was given.
        noise_before_px, noise_px: robust standard deviation of a coordinate of the residuals, before and after.
        contradictions: what speaks against the calibration.
    """

    file: str
    lenses: Sequence[LensChange]
    noise_before_px: float
    noise_px: float
    contradictions: Sequence[Contradiction]

    @property
    def text(self) -> str:
        """In words."""
        lenses = "; ".join(lens.text for lens in self.lenses)
        return (
            f"cameras of {self.file} in place of the model's ({lenses}); poses and points adjusted, residuals "
            f"{self.noise_before_px:.2f} to {self.noise_px:.2f} px"
        )


class UndistortedCamera(Report):
    """A pinhole; ``params``: fx, fy, cx, cy."""

    width: int
    height: int
    params: Sequence[float]


class UndistortNumbers(Report):
    """What ``sfmapp undistort`` has written.

    Attributes:
        num_images: pictures, which are the images of the model.
        num_faces: how many of them are faces of a cube.
        num_copied: files that had no distortion.
        num_dropped: observations outside of the pictures, or in photographs that are missing.
        calibration: the cameras of the model were replaced; absent where they were not.
    """

    num_images: int
    num_faces: int
    num_copied: int
    num_masks: int
    cameras: Sequence[UndistortedCamera]
    num_points: int
    num_observations: int
    num_dropped: int
    missing: Sequence[NamedReason]
    calibration: CalibratedModelReport | None = None


class UndistortReport(UndistortNumbers):
    """The report of ``sfmapp undistort``."""

    run: RunUsage


class CalibrateReport(Report):
    """The report of ``sfmapp calibrate``: of each way that was gone.

    Attributes:
        board: from photographs of a board.
    """

    board: BoardReport
    run: RunFacts


class CalibrateRigReport(Report):
    """The report of ``sfmapp calibrate rig``."""

    rig: RigReport
    run: RunFacts


class ExportReport(Report):
    """What ``sfmapp export`` has written and read back.

    Attributes:
        reader: what read it back.
        max_px: worst difference of a reprojection.
        max_coordinate: worst difference of a coordinate of a point, in units of the world.
        notes: what a user of the files has to know.
    """

    format: str
    files: Sequence[str]
    reader: str
    num_images: int
    num_points: int
    num_observations: int
    max_px: float
    max_coordinate: float
    notes: Sequence[str]


# ----------------------------------------------------------------------------------------------------------- odometry


class CameraParams(Report):
    """Model of a camera and its parameters by name."""

    model: str
    params: Mapping[str, float]


class SequenceCamera(CameraParams):
    """A camera of a sequence; ``refined``: what the last adjustment changed it to, None if it was believed."""

    width: int
    height: int
    focal_sigma_px: float | None
    source: str
    refined: CameraParams | None


class SequenceReport(Report):
    """What was played.

    Attributes:
        num_frames, frames_per_second: None where the sequence does not tell.
        stereo, imu, ground_truth: whether it has these.
        orientation: EXIF's, of its pictures.
    """

    kind: str
    num_frames: int | None
    frames_per_second: float | None
    stereo: bool
    imu: bool
    ground_truth: bool
    orientation: int
    cameras: Sequence[SequenceCamera]


class Gap(Report):
    """Frames without a pose; none of them where one map follows right after another.

    Attributes:
        duration_s: between the poses on both sides.
        map_before, map_after: None at the ends of the sequence.
    """

    first_frame: int
    last_frame: int
    num_frames: int
    duration_s: float
    map_before: int | None
    map_after: int | None


class FramesReport(Report):
    """Frames by what became of them; see :class:`~sfmapp.odometry.result.FrameState`."""

    num_frames: int
    num_unreadable: int
    num_with_pose: int
    num_in_largest_map: int
    waiting: int
    tracked: int
    relocalized: int
    lost: int
    repeated: int
    gaps: Sequence[Gap]


class MedianMax(Report):
    """Of standard deviations."""

    median: float
    max: float


class MapReport(Report):
    """One map in numbers.

    Attributes:
        path_length: in ``unit``: ``m``, or empty where the unit of length is arbitrary.
        scale_source, scale_sigma: of the unit of length; see :class:`~sfmapp.odometry.result.MapResult`.
        gauge: what the covariance holds fixed.
        position_sigma, rotation_sigma_deg: of the keyframes; None where not known.
        covariance_gap: why keyframes lack a covariance; empty where none does.
        adjustment: the closing adjustment; absent where there was none of the whole map.
    """

    idx: int
    num_frames: int
    first_frame: int | None
    last_frame: int | None
    num_keyframes: int
    num_points: int
    num_observations: int
    mean_track_length: float
    mean_reprojection_error_px: float
    path_length: float
    unit: str
    scale_source: str
    scale_sigma: float | None
    gauge: str
    position_sigma: MedianMax | None
    rotation_sigma_deg: MedianMax | None
    covariance_gap: str
    contradictions: Sequence[Contradiction]
    adjustment: AdjustReport | None = None


class GroundTruthReport(Report):
    """The error of the poses of a map against the ground truth, after an alignment: metres and degrees.

    Attributes:
        poses: ``final``, or ``live`` as they were given out while the sequence was played.
        scale: of the alignment.
        true_path_m: length of the true path.
    """

    map: int
    poses: Literal["final", "live"]
    alignment: str
    num_pairs: int
    scale: float
    true_path_m: float
    ate_m: Statistics
    rotation_deg: Statistics


class FrameTimes(Report):
    """Milliseconds, over the frames."""

    median: float
    p95: float
    max: float


class TimingReport(Report):
    """What a frame took; compiling kernels and drawing the recording are not counted.

    Attributes:
        times_real_time: speed against the camera's; None where its rate is not known.
        parts_cpu_ms: CPU milliseconds of a frame by part of the work.
        tracking_ms: CPU time of tracking; None where nothing was tracked.
    """

    num_frames: int
    wall_s: float
    frames_per_second: float
    times_real_time: float | None
    cpu_s: float
    cpu_ms_per_frame: float
    parts_cpu_ms: Mapping[str, float]
    tracking_ms: FrameTimes | None


class LiveReport(Report):
    """What came of a camera that does not wait, or of a program that pushes frames.

    Attributes:
        num_arrived: frames that it gave. num_dropped: of these, those that newer ones pushed out before they could be
            tracked.
        max_waiting: places for frames that wait to be tracked.
        longest_silence_s: longest time without a frame.
        end: why there were no more; empty while there may be.
        latency_ms: from when a frame came until its pose was known; None where none was tracked.
    """

    num_arrived: int
    num_dropped: int
    num_tracked: int
    max_waiting: int
    longest_silence_s: float
    end: str
    latency_ms: FrameTimes | None


class LensEvidence(Report):
    """How a lens was fitted to a reconstruction of the first minute.

    Attributes:
        distortion: coefficients by name.
        is_at_rest: the fit came to rest.
        spread: how many times their own standard deviations the focal lengths of parts differ; infinite: not known.
        has_distortion: some is clear.
        parts: focal lengths of parts of the frames, pixels.
        independent_sigma: of the focal length, by independent errors alone, pixels.
    """

    distortion: Mapping[str, float]
    is_at_rest: bool
    spread: float
    has_distortion: bool
    parts: Sequence[float]
    independent_sigma: float


class PairFocal(Report):
    """The focal length that fundamental matrices of pairs of frames tell, without the reconstruction; pixels."""

    focal_px: float
    sigma_px: float
    num_pairs: int


class CalibrationReport(CameraParams):
    """The camera that a self-calibration found; ``text``: in words.

    Attributes:
        sigma: standard deviations of the parameters by name; ``focal_sigma_relative``: of the focal length.
        pairs: what pairs of frames say of the focal length; absent where their motion tells none.
        is_settled: it is known as well as odometry needs.
        frames: names of those that were reconstructed.
    """

    sigma: Mapping[str, float]
    focal_sigma_relative: float
    is_settled: bool
    fit: LensEvidence
    frames: Sequence[str]
    num_registered: int
    num_points: int
    mean_reprojection_error_px: float
    text: str
    pairs: PairFocal | None = None


class OdometryStages(Report):
    """What each part of an odometry run said; absent where none was reached."""

    self_calibration: CalibrationReport | None = None
    kernels: Usage | None = None
    odometry: OdometryReport | None = None
    scale: Sequence[ScaleReport] | None = None
    filter: FilterReport | None = None


class OdometryRunReport(Report):
    """The report of ``sfmapp odometry``; ``timing`` is None without a frame, ``live`` of what was recorded before."""

    format: str
    outcome: Outcome
    run: RunFacts
    sequence: SequenceReport
    frames: FramesReport
    maps: Sequence[MapReport]
    ground_truth: Sequence[GroundTruthReport]
    timing: TimingReport | None
    live: LiveReport | None
    checks: Sequence[Check]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]
    stages: OdometryStages


class PhotoReport(Report):
    """What became of a photograph that was added to a map; ``reason``: why it was not registered, empty if it was."""

    name: str
    is_registered: bool
    reason: str
    num_correspondences: int | None = None
    num_pose_inliers: int | None = None


class MapsBeforeAfter(Report):
    """The maps of an odometry run, and what refinement made of them."""

    before: Sequence[MapReport]
    after: Sequence[MapReport]


class RefinedCamera(Report):
    """Parameters of a camera in COLMAP's order."""

    model: str
    params: Sequence[float]


class CamerasBeforeAfter(Report):
    """The cameras of the largest map."""

    before: Sequence[RefinedCamera]
    after: Sequence[RefinedCamera]


class GroundTruthBeforeAfter(Report):
    """Errors of the maps against the ground truth."""

    before: Sequence[GroundTruthReport]
    after: Sequence[GroundTruthReport]


class RefineReport(Report):
    """The report of ``sfmapp refine``; ``orientation``: EXIF's, of the pictures."""

    format: str
    outcome: Outcome
    run: RunFacts
    maps: MapsBeforeAfter
    cameras: CamerasBeforeAfter
    ground_truth: GroundTruthBeforeAfter
    orientation: int
    photographs: Sequence[PhotoReport]
    skipped: Sequence[NamedReason]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]
