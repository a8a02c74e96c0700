"""What georeferencing says of itself: which positions were believed, how well they fit, and where models lie."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.contradictions import Contradiction
from sfmapp.reporting import Report


class Finding(Report):
    """What is wrong, or odd, with positions.

    Attributes:
        images: names; empty for all.
        message: what was found, and what was done about it.
    """

    images: Sequence[str]
    message: str

    @property
    def sentence(self) -> str:
        """The message with the names before it, of which there are three at most."""
        if not self.images:
            return self.message
        more = f" and {len(self.images) - 3} more" if len(self.images) > 3 else ""
        return f"{', '.join(self.images[:3])}{more}: {self.message}"


class Ellipse(Report):
    """Standard deviations of a place: of the horizontal ellipse along its axes, the azimuth of the longer one from
    north to east, and of the height."""

    major_m: float
    minor_m: float
    azimuth_deg: float
    up_m: float


class PositionedImage(Report):
    """A photograph with a measured position.

    Attributes:
        model: that holds it; None for none.
        latitude_deg, longitude_deg, height_m: as measured; height_m None where unknown.
        source: of the measurement.
        measured_m: (3,) the same in the frame; the height is that of the frame's origin where it is unknown.
        adjusted_m: (3,) the camera's centre in the frame; absent where its model does not lie there.
        residual_m: (3,) adjusted minus measured, east, north and up; None for a height that is unknown.
        residual_sigma_m: (3,) what the residual should have as standard deviation.
        ellipse: how sure the adjusted place is; absent where not known.
        is_used: the adjustment leaned on it.
        reason: why not; empty if it did.
    """

    name: str
    model: int | None
    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    source: str
    measured_m: tuple[float, float, float]
    adjusted_m: tuple[float, float, float] | None = None
    residual_m: tuple[float, float, float | None] | None = None
    residual_sigma_m: tuple[float, float, float | None] | None = None
    ellipse: Ellipse | None = None
    is_used: bool
    reason: str


class PlacedModel(Report):
    """How a model lies in the world, or why it does not.

    Attributes:
        reason: why it was left in arbitrary units; empty if it lies in the frame.
        num_positions, num_used: photographs of it with a position, and those that the adjustment leaned on.
        scale_sigma_share: standard deviation of the scale as a share of it; rotation_sigma_deg: (3,) about east, north
            and up; position_sigma_m: (3,) of the mean of the cameras, were the errors of positions independent.
        sigma_m: (2,) of one position horizontally (along each axis) and vertically, median, as used:
            wider where errors of neighbours correlate.
        sigma_factor: (2,) what the residuals made of the sigmas as they were stated or guessed.
        rms_residual_m: (2,) of those used: horizontal distance, and height; None without heights.
        correlation: of errors of photographs taken one after the other, mean of what is likely; sigmas are wider for
            it.
        common_offset_m: what all positions may be off together beside that, which nothing here can show.
        leveled_by: what told the vertical where positions do not: ``gimbal``, ``photographs``; empty if they do.
        is_adjusted: positions took part in the adjustment; False: the model was moved as a whole.
        moved_m: root mean square by which that moved cameras against a motion of the whole.
        contradictions: between positions and photographs, or among positions, that could not be resolved.
    """

    model: int
    reason: str
    num_positions: int
    num_used: int
    scale_sigma_share: float | None = None
    rotation_sigma_deg: tuple[float, float, float] | None = None
    position_sigma_m: tuple[float, float, float] | None = None
    sigma_m: tuple[float, float] | None = None
    sigma_factor: tuple[float, float] | None = None
    rms_residual_m: tuple[float, float | None] | None = None
    correlation: float | None = None
    common_offset_m: tuple[float, float] | None = None
    leveled_by: str | None = None
    is_adjusted: bool | None = None
    moved_m: float | None = None
    contradictions: Sequence[Contradiction] = ()


class ClockReport(Report):
    """What the clock of photographs is off that of a track.

    Attributes:
        given_s: seconds that the user has given to add to it.
        offset_s: to add beside, by the way of the cameras; sigma_s: standard deviation. Absent where that tells none.
        is_applied: positions were taken anew with it.
        reason: why not; empty if they were.
    """

    given_s: float
    offset_s: float | None = None
    sigma_s: float | None = None
    is_applied: bool
    reason: str


class GeoreferenceReport(Report):
    """What the stage ``georeference`` did.

    Attributes:
        source: of the positions, as asked for.
        num_positions: photographs that have one.
        findings: what was wrong with them.
        models: as in the report, the largest first.
        images: those with a position.
        clock: of the photographs beside that of a track; absent where positions are of none.
    """

    source: str
    num_positions: int
    findings: Sequence[Finding]
    models: Sequence[PlacedModel]
    images: Sequence[PositionedImage]
    clock: ClockReport | None = None

    @property
    def contradictions(self) -> list[Contradiction]:
        """Those of all models."""
        return [found for model in self.models for found in model.contradictions]
