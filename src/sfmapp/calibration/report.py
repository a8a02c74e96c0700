"""What calibrations say of themselves in reports."""

from __future__ import annotations

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
