"""What reading the photographs has brought: what was found, skipped and known of their cameras."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import NamedReason, Report


class ImageProblem(Report):
    """What is odd about a photograph that is used all the same."""

    name: str
    problem: str


class CameraPrior(Report):
    """A camera before any photograph was matched.

    Attributes:
        params: of its model, in COLMAP's order.
        focal_px, focal_sigma_px: focal length and its standard deviation, pixels; None: not known.
        focal_source, focal_reason: where it comes from: a keyword, and in words.
        make, camera: as EXIF names them; empty where it does not.
        sharing: the rule by which the photographs share it.
    """

    camera_idx: int
    num_images: int
    model: str
    width: int
    height: int
    params: Sequence[float]
    focal_px: float
    focal_sigma_px: float | None
    focal_source: str
    focal_reason: str
    is_fixed: bool
    make: str
    camera: str
    sharing: str


class ImageFacts(Report):
    """A photograph as it was read.

    Attributes:
        orientation: EXIF's, 1 to 8.
        digest: of the file, or of the pixels in memory.
        mask: path of its mask; None without.
        format, kind, bits: of the file: ``jpeg``, ``rgb``, 8 and so on; absent where only pixels were given.
        timestamp: seconds since 1970 by the camera's clock; None: not known.
        gps: latitude and longitude in degrees, height in metres or None; None: not known.
    """

    name: str
    width: int
    height: int
    orientation: int
    camera_idx: int
    digest: str
    mask: str | None
    format: str | None = None
    kind: str | None = None
    bits: int | None = None
    timestamp: float | None
    gps: Sequence[float | None] | None


class ImagesReport(Report):
    """What the stage ``images`` found.

    Attributes:
        source, root: what was given, and the folder that names are relative to; of photographs in memory, a name for
            them, and nothing.
        results_passed_over: folders that hold results of sfmapp.
        num_bytes: of the files that are used; 0 of photographs in memory.
        duplicates: names of files that are the same, byte for byte.
    """

    source: str
    root: str
    results_passed_over: Sequence[str]
    num_found: int
    num_used: int
    num_skipped: int
    num_bytes: int
    num_with_gps: int
    num_with_time: int
    num_with_mask: int
    skipped: Sequence[NamedReason]
    problems: Sequence[ImageProblem]
    duplicates: Sequence[Sequence[str]]
    cameras: Sequence[CameraPrior]
    images: Sequence[ImageFacts]
    wall_s: float
