"""The photographs of a run: where they are, how to hold them up, and which camera took each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import CameraModel
from sfmapp.errors import UsageError
from sfmapp.images.position import Position
from sfmapp.option_checks import Range, check_options, positive

CameraSharing = Literal["auto", "all", "per_folder", "per_image"]


@dataclass(frozen=True)
class ImageOptions:
    """Which images are read, and what is known about their cameras.

    Attributes:
        camera: ``MODEL,PARAMETER,...``, as of ``camera_model`` and ``camera_params``, or the path of a calibration: of
            COLMAP (cameras.txt or .bin, or the folder of a model), OpenCV, Kalibr, ROS, ORB-SLAM, VINS, nerfstudio, or
            JSON. Several cameras are told apart by the names of images, or of folders such as cam0 and left. It is a
            prior, of one per cent of the focal length, unless ``fix_intrinsics`` holds it. None: from EXIF or a
            default.
        camera_model: lens model of all cameras.
        camera_params: parameters of ``camera_model`` in COLMAP's order, in pixels as the files store them, whatever
            EXIF's orientation; they describe one camera, so all images must have one size. None: from EXIF or a
            default.
        focal_px: focal length in pixels of all images; None: from EXIF or a default.
        fix_intrinsics: keep the cameras as they are read; nothing about them is refined.
        camera_sharing: which images share a camera. auto: those that EXIF or their names and sizes show to be of
            one camera and one zoom; ``all``, ``per_folder``: whatever has the same size; ``per_image``: none.
        mask_path: folder of masks, ``NAME.png`` for the image ``NAME`` (COLMAP's naming, as in ``a/b.jpg.png``) or the
            same name with ``.png`` for its ending; black is ignored. None: no masks.
        use_alpha: transparent parts of images with an alpha channel are ignored, like a mask.
        max_image_bytes: larger files are skipped.
        max_pixels: images with more pixels are skipped, by what their headers say.
    """

    camera: str | None = None
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL
    camera_params: tuple[float, ...] | None = None
    focal_px: float | None = None
    fix_intrinsics: bool = False
    camera_sharing: CameraSharing = "auto"
    mask_path: str | None = None
    use_alpha: bool = True
    max_image_bytes: int = 1 << 30
    max_pixels: int = 250_000_000

    def __post_init__(self) -> None:
        model = self.camera_model
        if isinstance(model, str):
            if model not in CameraModel.__members__:
                raise UsageError(f"camera_model is {model!r}", f"one of {', '.join(CameraModel.__members__)}")
            object.__setattr__(self, "camera_model", CameraModel[model])
        ranges = {"focal_px": positive(), "max_image_bytes": Range(1), "max_pixels": Range(1)}
        check_options("images", self, ranges)
        if self.camera_params is not None:
            self._check_params(tuple(float(value) for value in self.camera_params))
        if self.camera is not None:
            self._check_camera_is_alone()

    def _check_camera_is_alone(self) -> None:
        others = {
            "camera_model": self.camera_model != CameraModel.SIMPLE_RADIAL,
            "camera_params": self.camera_params is not None,
            "focal_px": self.focal_px is not None,
        }
        given = [f"images.{name}" for name, is_given in others.items() if is_given]
        if given:
            raise UsageError(
                f"images.camera and {' and '.join(given)} both say what the camera is", "leave one of them out"
            )

    def _check_params(self, params: tuple[float, ...]) -> None:
        object.__setattr__(self, "camera_params", params)
        names = PARAM_NAMES[self.camera_model]
        if len(params) != len(names):
            raise UsageError(
                f"camera_params has {len(params)} numbers, {self.camera_model.name} takes {len(names)}",
                f"give {', '.join(names)}",
            )
        if self.focal_px is not None:
            raise UsageError("camera_params and focal_px both give a focal length", "leave one of them out")
        focals = [value for name, value in zip(names, params, strict=True) if name in ("f", "fx", "fy")]
        if not all(abs(value) < float("inf") for value in params) or min(focals, default=1.0) <= 0.0:
            raise UsageError("camera_params must be finite numbers, focal lengths positive")


class ImageSource(Protocol):
    """Photographs that are not files: in memory, in an archive, in a database.

    Whatever has these three can be given wherever photographs are wanted. ``pixels`` and ``mask`` are called from
    several threads at a time, more than once for each image.

    Example:
        >>> class Archive:
        ...     def __init__(self, path):
        ...         self._file = numpy.load(path)
        ...         self.names = self._file.files
        ...     def pixels(self, name):
        ...         return self._file[name]
        ...     def mask(self, name):
        ...         return None
        >>> result = sfmapp.reconstruct(Archive("views.npz"))
    """

    @property
    def names(self) -> Sequence[str]:
        """I names, unique, with forward slashes: those of the images in every output."""
        ...

    def pixels(self, name: str) -> NDArray[Any]:
        """(H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA, uint8 or uint16."""
        ...

    def mask(self, name: str) -> NDArray[Any] | None:
        """(H, W), zero or False where nothing may be detected; None for no mask."""
        ...


@dataclass(frozen=True)
class ImageRecord:
    """One usable photograph.

    Attributes:
        name: posix path relative to the common root, unique; the image's name in every output.
        path: absolute path of the file; of one that has none, its name.
        width, height: of the pixels that the readers in ``pixels`` give: those of the file, whatever its orientation.
        orientation: EXIF orientation 1 to 8 of these pixels, for whoever shows them to people.
        turn: EXIF orientation that the readers undo. Not 1 only for photographs of a foreign model that counts in
            upright pixels; width, height and orientation are then those after turning.
        camera_idx: index into the cameras of the :class:`ImageSet`.
        digest: hex BLAKE2b (16 bytes) of the file's bytes.
        has_alpha: the file has an alpha channel that may serve as a mask.
        mask_path: its mask, None for none.
        timestamp: when it was taken, seconds since 1970 (a clock without a zone is read as UTC), None where unknown.
        position: where it was taken, None where unknown.
        make, model: of the camera, empty where unknown.
        source: what gives its pixels where it is no file; None: the file does.
    """

    name: str
    path: Path
    width: int
    height: int
    orientation: int = 1
    turn: int = 1
    camera_idx: int = 0
    digest: str = ""
    has_alpha: bool = False
    mask_path: Path | None = None
    timestamp: float | None = None
    position: Position | None = None
    make: str = ""
    model: str = ""
    source: ImageSource | None = field(default=None, compare=False, repr=False)

    @property
    def gps(self) -> tuple[float, float, float | None] | None:
        """Latitude and longitude in degrees and height in metres (None where unknown); None where unknown."""
        return None if self.position is None else self.position.gps


@dataclass(frozen=True)
class ImageSet:
    """The photographs of a run, in natural order of their names.

    Attributes:
        images: the usable ones.
        cameras: what ``camera_idx`` of the images points to, in order of first use.
        skipped: (name, reason) of the files that are not used.
        root: folder that the names are relative to: the source itself, or what a pattern or a list spans. None where
            the photographs are no files.
    """

    images: tuple[ImageRecord, ...]
    cameras: tuple[Camera, ...]
    skipped: tuple[tuple[str, str], ...] = ()
    root: Path | None = None

    @property
    def names(self) -> list[str]:
        """I names."""
        return [image.name for image in self.images]

    def camera_of(self, image_idx: int) -> Camera:
        """What is known beforehand of the camera that took an image."""
        return self.cameras[self.images[image_idx].camera_idx]
