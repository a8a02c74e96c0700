"""What poses that were known beforehand came to."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.contradictions import Contradiction
from sfmapp.reporting import Report


class KnownPoseRow(Report):
    """A photograph whose pose was known.

    Attributes:
        model: that holds it; None for none.
        is_used: the model leans on the pose.
        reason: why not; empty if it does.
        off: distance between the known place and that by photographs alone, in the unit of the file; off_deg: angle
            between the rotations. Absent where no model lies in the frame of the file.
        sigmas: length of this residual in standard deviations over all six numbers; 99.9 % of right ones are below
            4.74. Of a pose that is held, in those of what photographs tell, five times what independent errors make of
            it, and of what was stated.
    """

    name: str
    model: int | None
    is_used: bool
    reason: str
    off: float | None = None
    off_deg: float | None = None
    sigmas: float | None = None


class PositionsBeside(Report):
    """Measured positions of photographs (EXIF) held against a model in the frame of known poses, where they are not
    used: known poses bring their frame, and only positions tell where on Earth that is.

    Attributes:
        num_positions, num_agreeing: photographs of the model with one, and those that one similarity explains.
        disagreeing: names of the others; faults: what is wrong with each.
        reason: why they cannot be compared; empty if they can.
        unit_m: metres by positions of one unit of the frame; unit_sigma_m: its standard deviation.
        rms_residual_m: of those that agree, horizontally and in height; heights may be unknown.
        sigma_m: standard deviation of a position along east and north, as stated unless the residuals refute it.
        stated_sigma_m: as stated; absent where nobody did.
    """

    num_positions: int
    num_agreeing: int = 0
    disagreeing: Sequence[str] = ()
    faults: Sequence[str] = ()
    reason: str = ""
    unit_m: float | None = None
    unit_sigma_m: float | None = None
    rms_residual_m: tuple[float, float | None] | None = None
    sigma_m: float | None = None
    stated_sigma_m: float | None = None

    @property
    def sentence(self) -> str:
        """What was found, for people."""
        begin = (
            f"positions of {self.num_positions} photographs are not used beside known poses, which bring their frame"
        )
        if self.reason or self.rms_residual_m is None:
            return f"{begin}; they cannot be compared: {self.reason}"
        flat, up = self.rms_residual_m
        height = "" if up is None else f" and {up:.2g} m in height"
        return (
            f"{begin}; compared, {self.num_agreeing} agree with it, within {flat:.2g} m{height}, and one unit is "
            f"{self.unit_m:.4g} +- {self.unit_sigma_m:.2g} m"
        )


class PosedModel(Report):
    """How a model lies in the frame of known poses, or why it does not.

    Attributes:
        reason: why not; empty if it does.
        num_known, num_used: photographs of it with a known pose, and those that the adjustment leaned on, or held.
        sigma, sigma_deg: standard deviations of a known place along each axis and of a rotation about each axis, as
            stated where the residuals agree, else as these tell.
        sigma_factor: (2,) what residuals made of those that were stated; 1 where nothing was.
        scale: the unit of the file over that which photographs alone gave the model; absent where poses are held.
        scale_sigma_share: standard deviation of the scale as a share of it.
        is_adjusted: poses took part in the adjustment; False: the model was moved as a whole.
        positions: what measured positions say beside; absent where there are none.
    """

    model: int
    reason: str
    num_known: int
    num_used: int
    sigma: float | None = None
    sigma_deg: float | None = None
    sigma_factor: tuple[float, float] | None = None
    scale: float | None = None
    scale_sigma_share: float | None = None
    is_adjusted: bool | None = None
    positions: PositionsBeside | None = None


class PosesReport(Report):
    """What the stage ``poses`` did.

    Attributes:
        path: of the file.
        is_fixed: poses were held, and points triangulated from them.
        num_known: photographs with a pose in the file; num_strange: poses in it of no photograph.
        models: as in the report, the largest first.
        images: those with a known pose.
        contradictions: evidence against them that could not be resolved.
    """

    path: str
    is_fixed: bool
    num_known: int
    num_strange: int
    models: Sequence[PosedModel]
    images: Sequence[KnownPoseRow]
    contradictions: Sequence[Contradiction] = ()
