"""What is believed of poses that are known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import check_options, positive


@dataclass(frozen=True)
class PoseOptions:
    """Poses of photographs that are known beforehand, and how good they are.

    Attributes:
        file: a COLMAP model, a TUM trajectory whose times are names of images, cameras.json, or transforms.json of
            nerfstudio; models come to lie in its frame, in its unit. None: none.
        sigma_m: standard deviation of a camera's place along each axis, in the unit of the file; None: as the residuals
            tell.
        sigma_deg: of its rotation about each axis; None: as the residuals tell.
        fixed: poses are held as they are, and points triangulated from them; only those that the photographs clearly
            refute are named and let go.
    """

    file: str | None = None
    sigma_m: float | None = None
    sigma_deg: float | None = None
    fixed: bool = False

    def __post_init__(self) -> None:
        check_options("poses", self, {"sigma_m": positive(1e6), "sigma_deg": positive(180.0)})
