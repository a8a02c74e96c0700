"""What calibrations say of themselves in reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.reporting import Report


class CameraFileReport(Report):
    """A camera file for another program.

    Attributes:
        max_px: largest difference between the camera and what was read back; absent where nothing was written.
        reason: why nothing was written.
    """

    name: str
    program: str
    max_px: float | None = None
    reason: str | None = None


class BoardPictureReport(Report):
    """A photograph or frame of a board.

    Attributes:
        num_points: that were found; num_used: of these, those that count in the calibration.
        rms_px: of these.
        unused: why it has no part in the calibration.
        problem: why it stands out though it has a part.
        picked: why a frame of a video was taken.
        like: the frame that was taken for it, as it shows the same: nothing is wrong with it.
    """

    name: str
    num_points: int
    num_used: int
    rms_px: float | None = None
    unused: str | None = None
    problem: str | None = None
    picked: str | None = None
    like: str | None = None


class LensTrialReport(Report):
    """A lens model that was tried.

    Attributes:
        rms_px: of the views that it was fitted to.
        worst_px: largest sigma of a projection in the picture; absent where the views leave it open.
        held_out_px: of views that it was not fitted to; absent where it was not worth it.
        reason: why it was chosen, or left aside.
    """

    model: str
    num_params: int
    rms_px: float
    worst_px: float | None
    held_out_px: float | None = None
    reason: str


class BendReport(Report):
    """A board that is not flat: z = a u^2 + b v^2 + c u v, u and v from -1 to 1 over its points; in the board's unit.

    Attributes:
        coefficients, sigmas: a, b, c.
        depth: largest distance from a plane.
        rms_if_flat_px: of the residuals as if it were flat.
    """

    coefficients: Sequence[float]
    sigmas: Sequence[float]
    depth: float
    rms_if_flat_px: float


class ClosedFormReport(Report):
    """Zhang's closed form, before any refinement.

    Attributes:
        rank: directions of the six unknowns that the views hold; five are needed.
        singular_values: of the system, of the largest.
        k_matrix: rows; absent where there is none.
    """

    rank: int
    singular_values: Sequence[float]
    k_matrix: Sequence[Sequence[float]] | None = None


class NextViewReport(Report):
    """A view that is worth taking.

    Attributes:
        hint: how to take it.
        mean_sigma_px: of projections over the picture once it is taken, with those before it.
        outline: corners of the board in the picture, pixels.
    """

    hint: str
    mean_sigma_px: float
    outline: Sequence[Sequence[float]]


class BoardGuessReport(Report):
    """How a board was told from the photographs.

    Attributes:
        num_agree: photographs that show it; num_part: that may show a part of it; num_other: that show another;
            num_nothing: that show none.
        is_sure: three and more agree, and none shows another.
        notes: what to know of it.
    """

    num_agree: int
    num_part: int
    num_other: int
    num_nothing: int
    is_sure: bool
    notes: Sequence[str]


class BoardReport(Report):
    """What calibrating from a board came to.

    Attributes:
        board: as ``--board`` has it; unit: of its lengths, metres (``m``) or ``squares`` where nobody said how large
            they are.
        guess: how the board was told; absent where it was given.
        params, sigmas: by name, pixels and pure numbers.
        correlations: (P, P).
        rms_px: root mean square length of the residuals; noise_px: sigma of a coordinate, by degrees of freedom.
        lenses: that were tried, the chosen one first.
        bend: of the board, where the views show it; bend_note: what was found of it.
        median_sigma_px, worst_sigma_px, mean_sigma_px: of a projection over the picture, at the median distance of the
            boards; the mean is the root of the mean variance.
        next_views: what to photograph next, the best first.
        files: for other programs.
    """

    board: str
    unit: str
    guess: BoardGuessReport | None = None
    model: str
    width: int
    height: int
    params: Mapping[str, float]
    sigmas: Mapping[str, float]
    correlations: Sequence[Sequence[float]]
    rms_px: float
    noise_px: float
    degrees_of_freedom: int
    num_views: int
    pictures: Sequence[BoardPictureReport]
    lenses: Sequence[LensTrialReport]
    closed_form: ClosedFormReport
    bend: BendReport | None = None
    bend_note: str
    median_sigma_px: float
    worst_sigma_px: float
    mean_sigma_px: float
    next_views: Sequence[NextViewReport]
    files: Sequence[CameraFileReport]
    warnings: Sequence[str]


class ComparisonReport(Report):
    """What ``sfmapp calibrate compare`` prints with --json.

    Attributes:
        is_same: as far as the sigmas tell; chance: that the same camera differs as much, by chi2.
        turn_deg: that was taken out.
        median_px, largest_px: length of the difference over the picture.
        largest_at: pixel where it is largest; largest_sigma_px: sigma of a coordinate of it there.
    """

    is_same: bool
    chance: float
    chi2: float
    degrees_of_freedom: int
    turn_deg: float
    median_px: float
    largest_px: float
    largest_at: Sequence[float]
    largest_sigma_px: float
