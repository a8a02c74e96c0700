"""What tracking a sequence has brought, beside the trajectory and the maps themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from sfmapp.contradictions import Contradiction
from sfmapp.reporting import Report


class BeliefReport(Report):
    """Where a camera might have been in a known map, as far as images told.

    Attributes:
        num_looks: frames that were held against it. num_open: those after which several of its places fitted, and
            none was believed. num_looks_to_decision: after which a place was believed first; absent if none was.
        places: keyframes of the map near which the camera might be after the last of them, the likeliest first, and
            probabilities: theirs. not_in_map: probability that it is in none of its places.
        max_doubt: most that all else together may have where a place is believed.
        max_particles: most that there were at a time.
    """

    num_looks: int
    num_open: int
    places: list[str]
    probabilities: list[float]
    not_in_map: float
    max_doubt: float
    max_particles: int
    num_looks_to_decision: int | None = None


class KnownMapReport(Report):
    """What a map that was there before has to do with a sequence.

    Attributes:
        source: of the known map. num_keyframes, num_places: keyframes (or photographs) of it, and those that have a
            picture by which a place can be recognised.
        is_found: frames were found in it.
        num_localised: frames whose pose was measured against its landmarks. num_new: frames with a pose in its frame,
            which see what was mapped anew. num_elsewhere: frames with a pose in a map of their own.
        belief: how it was found there, or why not.
        max_sigmas: beyond that, position_sigmas or rotation_sigmas are a contradiction.
        position_sigmas, rotation_sigmas: what the poses of keyframes by its landmarks alone, and by the sequence alone,
            differ by, rms, in standard deviations. Absent where fewer than three keyframes tell.
        moved: what positions differ by, rms, as a share of the size of the path.
        worst: the frame that differs most.
    """

    source: str
    num_keyframes: int
    num_places: int
    is_found: bool
    num_localised: int
    num_new: int
    num_elsewhere: int
    belief: BeliefReport
    max_sigmas: float
    position_sigmas: float | None = None
    rotation_sigmas: float | None = None
    moved: float | None = None
    worst: str | None = None


class OdometryReport(Report):
    """Counts of an odometry run.

    Attributes:
        num_keyframes: of each map.
        tracking_cpu_s, backend_cpu_s: CPU seconds of tracking and of local adjustment.
        loops_open: that were seen and not closed, as what they show may be elsewhere as well.
        looked_still, looked_turned: frames in which the camera seemed to stand still, or to turn on the spot, before
            there was a map. twins: frames of a map that showed what the one before showed.
        right_late_frames: by how many frames the images of the second camera came late.
        pairs: what contradicts that the images of the two cameras are of the same moments.
        known_map: of the map that was there before; absent without one.
    """

    num_frames: int
    num_tracked: int
    num_maps: int
    num_keyframes: Sequence[int]
    tracking_cpu_s: float
    backend_cpu_s: float
    relocalizations: int
    losses: int
    loops: int
    loops_open: int
    keyframes_culled: int
    looked_still: int
    looked_turned: int
    twins: int
    right_late_frames: int
    pairs: Sequence[Contradiction]
    known_map: KnownMapReport | None = None


class MapFacts(Report):
    """What a map has beside its model and its trajectory, as ``run.json`` keeps it; see :class:`MapResult`."""

    scale_source: str
    scale_sigma: float | None
    contradictions: Sequence[Contradiction]


# ------------------------------------------------------------------------------------------- the end of a map


class ScaleParts(Report):
    """What the relative standard deviation of a rig's unit of length is made of.

    Attributes:
        baseline, calibration, disparity: of the measured baseline, of what the images leave open of the calibration,
            and of the noise of disparities.
        focal, aspect, distortion, turn: each part of the calibration alone.
        shift: what another calibration, which the images would rather have, makes of the length.
        sigma: all of it.
        beyond_the_lens_model: what a refined calibration adds for what no lens model has.
    """

    baseline: float
    calibration: float
    focal: float
    aspect: float
    distortion: float
    turn: float
    disparity: float
    shift: float
    sigma: float
    beyond_the_lens_model: float | None = None


class CalibrationCheck(Report):
    """What the images of a map say of the calibration that was given; absent where they tell nothing.

    Attributes:
        is_refined: it was replaced by what they say.
        surprise, max_surprise: how much they are against it, and how much errors of patches alone may be.
        noise_inflation: how much more the data vary than independent errors would.
        change, sigma: what they would change, by name, and how sure they are of it.
        held_out_sigmas, direction_sigmas: what other tracks gain by the change, all of it and direction by direction.
        is_settled: looking for it has come to rest.
        given, refined: parameters of the cameras. focal_change: relative.
        scale: of a rig: what its unit of length is known by.
    """

    is_refined: bool
    surprise: float | None = None
    max_surprise: float | None = None
    noise_inflation: float | None = None
    change: Mapping[str, float] | None = None
    sigma: Mapping[str, float] | None = None
    held_out_sigmas: float | None = None
    direction_sigmas: Sequence[float] | None = None
    is_settled: bool | None = None
    given: Sequence[Sequence[float]] | None = None
    focal_change: Sequence[float] | None = None
    refined: Sequence[Sequence[float]] | None = None
    scale: ScaleParts | None = None


class ShutterReport(Report):
    """What looking for a rolling shutter has found.

    Attributes:
        readout: time from the first row to the last as a share of the time between frames; 0 where nothing was changed.
        first_readout, evidence, min_evidence: the first one found, what it explains in units of the noise, and what it
            must.
    """

    evidence: float
    min_evidence: float
    first_readout: float
    readout: float


class FilterConsistency(Report):
    """How far poses were from where a filter expected them, against what it expected of that.

    Attributes:
        num_innovations: poses that were compared, those that were not believed among them.
        mean: of the normalised innovations squared, a degree of freedom: 1 where all is as modelled, and within
            mean_low to mean_high in 95 % of runs then.
        share_inside: of them inside the 95 % interval of one, both sides.
        num_independent: how many independent ones they are worth, as their squares are correlated in time;
            correlated_low, correlated_high: within which the mean is in 95 % of runs, of so many.
        correlation: of innovations with those of the frame before; white ones have less than max_correlation, either
            way, in 95 % of runs. Absent where only their squares are known.
    """

    num_innovations: int
    mean: float
    mean_low: float
    mean_high: float
    share_inside: float
    num_independent: float
    correlated_low: float
    correlated_high: float
    max_correlation: float
    correlation: float | None = None


class RejectedPose(Report):
    """A pose that a filter did not believe."""

    name: str
    timestamp_s: float
    reason: str


class FilterGap(Report):
    """A stretch without poses that a filter has bridged; sigmas at its end, in the map's unit and in degrees."""

    first_s: float
    last_s: float
    position_sigma: float
    rotation_sigma_deg: float


class FilterReport(Report):
    """What the error-state filter made of the live poses of the map with the most of them.

    Attributes:
        prediction: ``imu`` or ``constant velocity``; reason: why not by the sensor, where there is one.
        num_poses: that were written; rate_hz: how many a second, in the middle.
        num_used: measured poses that corrected it.
        rejected: those that did not. gaps: that were bridged.
        consistency: absent where nothing could be compared.
        latency_ms_median, latency_ms_p95, latency_ms_max: from a sample or a pose to the filtered pose, the tracking of
            the frame left out.
        white_share, walk_share: of the variance of a pose, in the middle: what is new in each frame and gone in the
            next, and what is added from frame to frame and stays with the map.
        contradictions: innovations that were larger than sigmas say, for longer than chance would have it.
    """

    prediction: str
    num_poses: int
    rate_hz: float
    num_used: int
    rejected: Sequence[RejectedPose]
    gaps: Sequence[FilterGap]
    latency_ms_median: float
    latency_ms_p95: float
    latency_ms_max: float
    white_share: float
    walk_share: float
    reason: str | None = None
    consistency: FilterConsistency | None = None
    contradictions: Sequence[Contradiction] = ()


class SharedErrors(Report):
    """By how much errors that observations share make the variance of the poses larger: along tracks, and between.

    ``wider_loss_sigmas``: how far a loss that believes more observations moves the keyframes, rms, in standard
    deviations that these give; where it is above one, covariances have grown by what is more.
    """

    within_tracks: float
    between_tracks: float
    wider_loss_sigmas: float | None = None


class PlaneEvidence(Report):
    """The plane that a camera on wheels moves in.

    Attributes:
        state: ``held``: the closing adjustment holds the keyframes to it; ``offered``: the motion, taken to be free,
            looks as if it could; ``dropped``: it was asked for and does not hold.
        reason: why, with the numbers behind it.
        turned_deg: how far the camera turned in the plane.
        deviation_deg: (2,) nod and roll about the plane, rms. deviation_height: of the camera's height, map units, rms.
        sigma_deg, sigma_height: the standard deviations that they were held with: learned, and as much larger as
            deviations hang together along the way, by ``hang_together`` (3,) of the variances of nod, roll and height.
        up_in_cam: (3,) the plane's normal as the camera sees it.
        camera_pitch_deg: of the optical axis above the plane; camera_roll_deg: of the normal to the right in the
            picture; and their standard deviations.
    """

    state: str
    reason: str
    turned_deg: float | None = None
    deviation_deg: Sequence[float] | None = None
    deviation_height: float | None = None
    sigma_deg: Sequence[float] | None = None
    sigma_height: float | None = None
    hang_together: Sequence[float] | None = None
    up_in_cam: Sequence[float] | None = None
    camera_pitch_deg: float | None = None
    camera_roll_deg: float | None = None
    camera_pitch_sigma_deg: float | None = None
    camera_roll_sigma_deg: float | None = None


class AdjustmentReport(Report):
    """The adjustment of a whole map at its end.

    Attributes:
        camera: the calibration, held against the images.
        sigma_px: the noise of an observation.
        covariance: absent where none was asked for.
        shutter: absent where it was not looked for.
        is_piecewise: the map is too large to be adjusted at once.
        inertial: measurements of a sensor that took part, or why they did not; absent without one.
        plane: that of a camera on wheels; absent where the motion is free and does not look like one.
        num_frames: frames between the keyframes that were adjusted with them in the end; absent where none were.
    """

    camera: CalibrationCheck
    sigma_px: float | None = None
    covariance: SharedErrors | None = None
    shutter: ShutterReport | None = None
    is_piecewise: bool | None = None
    inertial: ScaleEvidence | None = None
    plane: PlaneEvidence | None = None
    num_frames: int | None = None


# ------------------------------------------------------------------------------------------- the unit of length


class DistanceEvidence(Report):
    """A known distance between two frames, in metres, and what it measures in the map; absent: not known."""

    metres: float | None = None
    sigma_m: float | None = None
    distance_map_units: float | None = None


class PathEvidence(Report):
    """A known length of the path; ``path_of_every_second_map_units``: without every second pose."""

    metres: float
    sigma_m: float
    path_map_units: float
    path_of_every_second_map_units: float
    num_poses: int


class HeightEvidence(Report):
    """A known height of the camera over the ground.

    Attributes:
        num_keyframes, num_keyframes_with_ground: of the map, and those below which a plane was found.
        height_map_units: median. relative_spread: of the heights. last_over_first_third: of the map, which is drift.
        median_points, median_keyframe_sigma: of the planes.
    """

    metres: float
    sigma_m: float
    num_keyframes: int
    num_keyframes_with_ground: int
    height_map_units: float | None = None
    relative_spread: float | None = None
    last_over_first_third: float | None = None
    median_points: int | None = None
    median_keyframe_sigma: float | None = None


class MarkerRow(Report):
    """A marker that was measured."""

    side_map_units: float
    sigma_relative: float
    num_images: int


class MarkerEvidence(Report):
    """Markers whose sides are known; ``markers``: by id."""

    metres: float
    sigma_m: float
    num_sightings: int
    markers: Mapping[str, MarkerRow]


class Fault(Report):
    """What would explain measurements that contradict the map; ``residual``: what is left a degree of freedom then."""

    fault: str
    remedy: str
    residual: float


class InertialEvidence(Report):
    """Inertial measurements against a map, as far as the alignment came.

    Attributes:
        rotation_residual_deg, rotation_deg: of an interval: what gyroscope and map differ by, and how far it turns.
        condition: of the linear start.
        position_sigma_map_units: noise of the positions as they fit to start with.
        residual: what the measurements add to the cost, twice, over the degrees of freedom that they bring.
        gravity_in_map: (3,) m/s^2, downwards. gravity_sigma_deg: of its direction.
        gyro_bias, accel_bias: (3,) rad/s and m/s^2.
        clock_offset_s, clock_sigma_s: to be added to a time of the frames for that of the measurements.
        mounting_turn_deg: (3,) how the sensor is turned from the given mounting, about its own axes; mounting_shift_m:
            (3,) how far it is from its given place, along the camera's axes; and their standard deviations.
        explained_by: what may be wrong with the measurements, where they contradict the map.
    """

    num_poses: int
    num_intervals: int
    rotation_residual_deg: float | None = None
    rotation_deg: float | None = None
    condition: float | None = None
    position_sigma_map_units: float | None = None
    residual: float | None = None
    gravity_sigma_deg: float | None = None
    gravity_in_map: Sequence[float] | None = None
    gyro_bias: Sequence[float] | None = None
    accel_bias: Sequence[float] | None = None
    clock_offset_s: float | None = None
    clock_sigma_s: float | None = None
    mounting_turn_deg: Sequence[float] | None = None
    mounting_turn_sigma_deg: Sequence[float] | None = None
    mounting_shift_m: Sequence[float] | None = None
    mounting_shift_sigma_m: Sequence[float] | None = None
    explained_by: Sequence[Fault] | None = None


ScaleEvidence: TypeAlias = InertialEvidence | MarkerEvidence | HeightEvidence | PathEvidence | DistanceEvidence
"""Numbers behind a unit of length, by its source."""


class ScaleReport(Report):
    """Where the metres of a map come from, or why there are none.

    Attributes:
        source: what was asked for.
        evidence: numbers behind it; which, hangs on the source.
        metres_per_unit, sigma_relative: of the map's first unit of length; absent where none could be had.
        reason: why none could be had; absent elsewhere.
    """

    map: int
    source: str
    evidence: ScaleEvidence
    metres_per_unit: float | None = None
    sigma_relative: float | None = None
    reason: str | None = None
