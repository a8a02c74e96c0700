"""Where pairs come from, and what is known of their cameras."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.opencv_lens import exact_camera
from sfmapp.camera_files.reading import Calibration, kitti_calibration, read_calibration
from sfmapp.errors import InputError, UsageError
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.calibration.known_points import describe_photograph
from sfmapp.scene.rig import Rig
from sfmapp.sequences.files import list_images
from sfmapp.sequences.kitti import is_kitti
from sfmapp.stereo.prepare import PairCameras

Pixels = NDArray[np.uint8]
Size = tuple[int, int]

_KITTI_PAIRS = (("image_2", "image_3"), ("image_0", "image_1"))


@dataclass(frozen=True)
class KnownCameras:
    """What the user says of the cameras of his pairs.

    Attributes:
        camera: path of a calibration of two cameras, of any form that is read.
        focal_px, baseline_m, doffs_px: of rectified photographs; the principal point is then taken to be in the middle.
    """

    camera: str | None = None
    focal_px: float | None = None
    baseline_m: float | None = None
    doffs_px: float | None = None

    def __post_init__(self) -> None:
        if self.camera is not None and (self.focal_px is not None or self.baseline_m is not None):
            raise UsageError(
                "--camera and --focal or --baseline both say what the cameras are", "leave one of them out"
            )
        if self.focal_px is None and (self.baseline_m is not None or self.doffs_px is not None):
            raise UsageError("--baseline and --doffs need the focal length of the rectified pair", "give --focal too")
        for name, value in (("--focal", self.focal_px), ("--baseline", self.baseline_m)):
            if value is not None and not 0.0 < value < np.inf:
                raise UsageError(f"{name} is {value:g}, expected more than 0")
        if self.doffs_px is not None and not np.isfinite(self.doffs_px):
            raise UsageError(f"--doffs is {self.doffs_px:g}, expected a number of pixels")


@dataclass(frozen=True)
class ChosenPairs:
    """Which of many pairs are looked at.

    Attributes:
        names: of two images of a reconstruction; None: its ``best`` pairs, so many. step: every so-many-th pair of
            folders and frame of a video.
    """

    names: tuple[str, str] | None = None
    best: int = 1
    step: int = 1

    def __post_init__(self) -> None:
        for name, value in (("--best", self.best), ("--step", self.step)):
            if value < 1:
                raise UsageError(f"{name} is {value}, expected 1 or more")


@dataclass(frozen=True)
class PairSource:
    """One pair.

    Attributes:
        name: of the pair. left, right: names of the photographs.
        read: gives both, (H, W, 3).
        cameras: what is known of them, of the sizes of the photographs.
        digests: of the files, by name.
        is_frame: of a film: the pair before it was taken shortly before.
    """

    name: str
    left: str
    right: str
    read: Callable[[], tuple[Pixels, Pixels]]
    cameras: Callable[[], PairCameras]
    digests: dict[str, str]
    is_frame: bool = False


def find_pairs(sources: Sequence[str | os.PathLike[str]], known: KnownCameras) -> Iterator[PairSource]:
    """The pairs of a source, one after another.

    Args:
        sources: two photographs; two folders, whose files belong together by name; or a folder of KITTI.

    Raises:
        UsageError: another number of sources, or a photograph and a folder.
        InputError: nothing there, or no pair in it.
    """
    paths = [Path(one) for one in sources]
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: expected a photograph or a folder, found nothing there")
    if len(paths) == 2 and all(path.is_file() for path in paths):
        yield _of_files("", paths[0], paths[1], known)
    elif len(paths) == 2 and all(path.is_dir() for path in paths):
        yield from _of_folders(paths[0], paths[1], known)
    elif len(paths) == 1 and paths[0].is_dir() and is_kitti(paths[0]):
        yield from _of_kitti(paths[0], known)
    else:
        found = ", ".join(f"{path} ({'a folder' if path.is_dir() else 'a file'})" for path in paths) or "nothing"
        raise UsageError(
            "expected two photographs, two folders of them, a folder of KITTI, a video or a reconstruction, found "
            f"{found}"
        )


def _of_files(
    name: str, left: Path, right: Path, known: KnownCameras,
    calibration: Callable[[Size, Size], PairCameras] | None = None,
) -> PairSource:  # fmt: skip
    records = describe_photograph(left), describe_photograph(right)

    def cameras() -> PairCameras:
        sizes = _size(records[0]), _size(records[1])
        return cameras_of(known, sizes) if calibration is None else calibration(*sizes)

    return PairSource(
        name, os.fspath(left), os.fspath(right), lambda: (read_rgb(records[0]), read_rgb(records[1])), cameras,
        {str(left): records[0].digest, str(right): records[1].digest},
    )  # fmt: skip


def _size(record: ImageRecord) -> Size:
    return record.width, record.height


def _of_folders(
    left: Path, right: Path, known: KnownCameras, calibration: Callable[[Size, Size], PairCameras] | None = None
) -> Iterator[PairSource]:
    """Files of one name without its ending, or without the one word that differs: ``left01`` and ``right01``."""
    first, second = list_images(left), list_images(right)
    partners = {path.stem: path for path in second}
    pairs = [(path, partners[path.stem]) for path in first if path.stem in partners]
    if not pairs and len(first) == len(second) and _tails(first) == _tails(second):
        pairs = list(zip(first, second, strict=True))
    if not pairs:
        raise InputError(
            f"{left}, {right}: expected photographs of the same names in both, found {len(first)} and {len(second)} "
            "without a common one",
            "rename them, so that what was taken together has one name",
        )
    for one, other in pairs:
        yield _of_files(one.stem, one, other, known, calibration)


def _tails(paths: Sequence[Path]) -> list[str]:
    """Names without the letters that they begin with."""
    return [path.stem.lstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ_-") for path in paths]


def _of_kitti(folder: Path, known: KnownCameras) -> Iterator[PairSource]:
    pair = next(((a, b) for a, b in _KITTI_PAIRS if (folder / a).is_dir() and (folder / b).is_dir()), None)
    if pair is None:
        raise InputError(f"{folder}: expected image_0 and image_1, or image_2 and image_3, found one of two cameras")
    path = folder / "calib.txt"
    calibration = None
    if known.camera is None and known.focal_px is None and path.is_file():

        def calibration(left: Size, right: Size) -> PairCameras:
            return _of_calibration(kitti_calibration(path, [left, right], int(pair[0][-1])), str(path))

    yield from _of_folders(folder / pair[0], folder / pair[1], known, calibration)


def cameras_of(known: KnownCameras, sizes: tuple[Size, Size]) -> PairCameras:
    """What is known of the cameras of photographs of some sizes.

    Raises:
        InputError: the calibration cannot be read, is of one camera, or of pictures of another shape.
    """
    if known.camera is not None:
        return _of_calibration(read_calibration(known.camera, sizes), known.camera)
    if known.focal_px is None:
        return PairCameras()
    width, height = sizes[0]
    centers = 0.5 * width, 0.5 * width + (known.doffs_px or 0.0)
    cameras = tuple(
        Camera(CameraModel.PINHOLE, width, height, np.array([known.focal_px, known.focal_px, cx, 0.5 * height]))
        for cx in centers
    )
    pose = np.array([0.0, 0.0, 0.0, 1.0, -(known.baseline_m or 1.0), 0.0, 0.0])
    rig = Rig(cameras, np.array([rigid3.IDENTITY, pose]))
    text = f"focal length {known.focal_px:g} px, rectified, as given"
    return PairCameras(rig, known.baseline_m is not None, text)


def _of_calibration(found: Calibration, place: str) -> PairCameras:
    if not found.rig.is_stereo:
        raise InputError(
            f"{place}: expected two cameras and the pose of the second, found one camera",
            "sfmapp calibrate rig finds both",
        )
    cameras = tuple(
        _exact(camera, lens) for camera, lens in zip(found.rig.cameras, found.lenses, strict=True)
    )  # fmt: skip
    # of a lens that is read with more coefficients than its simpler stand-in nothing is stated
    sizes = sum(len(camera.params) for camera in cameras) + 6
    covariance = found.covariance if found.covariance is not None and len(found.covariance) == sizes else None
    return PairCameras(rig=Rig(cameras, found.rig.cam_from_rig), text=place, covariance=covariance)


def _exact(camera: Camera, lens: object) -> Camera:
    """The camera with all coefficients of its file: here no frame has to be resampled for a simpler one."""
    from sfmapp.camera_files.opencv_lens import FullLens

    exact = exact_camera(lens) if isinstance(lens, FullLens) else None
    return camera if exact is None else exact
