"""What a calibration says of photographs: which of its cameras took which of them, at the size that they have."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePath, PurePosixPath

import numpy as np

from sfmapp.camera.camera import Camera
from sfmapp.camera_files.fields import (
    camera_from_text,
    camera_of_fields,
    cameras_in,
    is_calibration_path,
    oddity,
    stated_size,
)
from sfmapp.camera_files.files import read_fields
from sfmapp.camera_files.opencv_lens import CalibratedCamera, Size, exact_camera, scaled_to
from sfmapp.errors import InputError
from sfmapp.geometry.orientation import INVERSE, is_sideways
from sfmapp.scene.turned_camera import fault_of_upright, turned_camera

CameraAt = Callable[[Size], CalibratedCamera]
"""A camera of the size that its calibration states, or of that of the images where it states none."""

# cam0, camera_1, image_02, left: folders, and cameras in files, that are the first, the second, ...
_NUMBERED = re.compile(r"(?:cam|camera|image|images|img)[_-]?(\d+)")
_OF_A_PAIR = re.compile(r"(?:(?:cam|camera|image|images|img)[_-]?)?(left|right)")
_NAMES_SHOWN = 4
# a share of a side of the picture: lenses are decentred by some per cent at most, crops by more
_FAR_OFF_CENTER = 0.15


@dataclass(frozen=True)
class Photograph:
    """What is to be known of a photograph: its name with forward slashes, its size in pixels of the file, and EXIF's
    orientation of it."""

    name: str
    size: Size
    orientation: int = 1


@dataclass(frozen=True)
class GivenCamera:
    """The camera of photographs of one size.

    Attributes:
        name: in the file; may be empty where there is one only.
        camera: with ``focal_source`` ``user`` and a sigma of its focal length.
        reason: where it is from, and what was changed on the way.
        problem: what is odd about it; None for nothing.
    """

    name: str
    camera: Camera
    reason: str
    problem: str | None = None


@dataclass(frozen=True)
class GivenCameras:
    """The cameras that a user gives.

    Attributes:
        place: what was given; begins the messages.
        cameras: by name; of a file with one, the name may be empty.
        sizeless: names of those that do not state the size of their images.
        of_image: names of cameras by the names of images that they took, where the file lists them.
    """

    place: str
    cameras: Mapping[str, CameraAt]
    sizeless: Collection[str] = ()
    of_image: Mapping[str, str] = field(default_factory=dict)

    def of_photographs(self, root: str, photographs: Sequence[Photograph]) -> list[GivenCamera]:
        """The camera of each of N photographs, in pixels of their files; the same object for the same camera and size.

        Where there are several, the file tells them apart by the names of images, or else by those of folders:
        ``left/0001.jpg`` was taken by ``left``, or by ``cam0``. A photograph that it does not name was taken by the
        camera of all those of its size that it names. A camera of another size but the same shape is scaled, one for
        pictures that were turned upright as EXIF says is turned back.

        Args:
            root: folder that the names are relative to; its own name, and that of the one it is in, count as well.
            photographs: N of them.

        Raises:
            InputError: it does not tell the cameras apart, or is of pictures of another shape or orientation, or its
                lens is none of ours.
        """
        whose = self._whose(root, photographs)
        groups: defaultdict[tuple[str, Size], list[Photograph]] = defaultdict(list)
        for name, photograph in zip(whose, photographs, strict=True):
            groups[name, photograph.size].append(photograph)
        for name in dict.fromkeys(whose):
            self._check_states_size(name, [group[0] for (of, _), group in groups.items() if of == name])
        found = {key: self._in_pixels_of(key[0], group) for key, group in groups.items()}
        return [found[name, photograph.size] for name, photograph in zip(whose, photographs, strict=True)]

    # ------------------------------------------------------------------------------------------------ which camera

    def _whose(self, root: str, photographs: Sequence[Photograph]) -> list[str]:
        if len(self.cameras) == 1:
            return [*self.cameras] * len(photographs)
        by_tail, by_folder = _by_tail(self.of_image), self._by_folder()
        found = [_of_image(by_tail, photograph.name) for photograph in photographs]
        of_size: defaultdict[Size, set[str]] = defaultdict(set)
        for camera, photograph in zip(found, photographs, strict=True):
            if camera is not None:
                of_size[photograph.size].add(camera)
        whose = []
        for photograph, named in zip(photographs, found, strict=True):
            folders = [*PurePath(root).parts[-2:], *PurePosixPath(photograph.name).parent.parts]
            keys = [key for folder in reversed(folders) for key in self._keys(folder)]
            camera = named or next((by_folder[key] for key in keys if key in by_folder), None)
            if camera is None and len(of_size[photograph.size]) == 1:
                (camera,) = of_size[photograph.size]
            if camera is None:
                raise self._untold(photograph.name)
            whose.append(camera)
        return whose

    def _by_folder(self) -> dict[str, str]:
        """Names of cameras by what :meth:`_keys` gives of their names and of the folders of their images."""
        found: defaultdict[str, set[str]] = defaultdict(set)
        names = [(name, name) for name in self.cameras]
        names += [(PurePosixPath(image).parent.name, camera) for image, camera in self.of_image.items()]
        for name, camera in names:
            for key in self._keys(name):
                found[key].add(camera)
        return {key: next(iter(cameras)) for key, cameras in found.items() if len(cameras) == 1}

    def _keys(self, folder: str) -> list[str]:
        """A name without the case of its letters, and its number if it has one."""
        name = folder.lower()
        keys = [name] if name else []
        if match := _NUMBERED.fullmatch(name):
            keys.append(f"#{int(match[1])}")
        elif len(self.cameras) == 2 and (match := _OF_A_PAIR.fullmatch(name)):
            keys.append("#0" if match[1] == "left" else "#1")
        return keys

    def _untold(self, photograph: str) -> InputError:
        cameras, images = ", ".join([*self.cameras][:_NAMES_SHOWN]), [*self.of_image][:_NAMES_SHOWN]
        has = f", for images such as {', '.join(images)}" if images else ""
        return InputError(
            f"{self.place}: cannot tell which camera took {photograph}, found {len(self.cameras)} cameras "
            f"({cameras}){has}",
            "put what each camera took into a folder with its name (cam0, left, ...), or give a file with the one "
            "camera that took all",
        )

    # ----------------------------------------------------------------------------------------------- of which pixels

    def _check_states_size(self, name: str, photographs: Sequence[Photograph]) -> None:
        """Refuse a camera that states no size for photographs of several."""
        if len(photographs) > 1 and name in self.sizeless:
            sizes = sorted(photograph.size for photograph in photographs)
            shown = ", ".join(f"{width}x{height}" for width, height in sizes[:_NAMES_SHOWN])
            raise InputError(
                f"{self.place}: expected a camera of one image size, found none stated, and photographs of several: "
                f"{shown}",
                "write width and height into the calibration file, or leave out the images of other sizes",
            )

    def _in_pixels_of(self, name: str, group: Sequence[Photograph]) -> GivenCamera:
        first = group[0]
        found = self._at(name, first.size)
        own = (found.camera.width, found.camera.height)
        sideways = sorted({photograph.orientation for photograph in group if is_sideways(photograph.orientation)})
        if _has_shape(own, first.size):
            found = scaled_to(self.place, found, first.size)
            self._check_not_of_upright(found.camera, first.name, sideways)
        elif len(sideways) == 1 and _has_shape(own, first.size[::-1]):
            found = scaled_to(self.place, found, first.size[::-1])
            note = "made with pictures turned upright as EXIF says, turned back to the pixels of the files"
            turned = turned_camera(found.camera, INVERSE[sideways[0]])
            found = replace(found, camera=turned, notes=(*found.notes, note))
        else:
            raise self._misshapen(own, first)
        source = ": ".join([PurePath(self.place).name, *([name] if name else [])])
        reason = ", ".join([source, *(note.removeprefix(f"{self.place}: ") for note in found.notes)])
        problem = oddity(found.camera) or self._other_size(name, found.camera)
        return GivenCamera(name, replace(found.camera, focal_source="user"), reason, problem)

    def _at(self, name: str, size: Size) -> CalibratedCamera:
        """A camera with all that its lens has: photographs are not resampled, as frames are."""
        found = self.cameras[name](size)
        if found.lens is None:
            return found
        exact = exact_camera(found.lens)
        if exact is None:
            raise InputError(
                f"{self.place}: expected a sensor perpendicular to the optical axis, found a tilted one (tau_x, tau_y)",
                "calibrate without cv2.CALIB_TILTED_MODEL, or undistort the photographs first",
            )
        return CalibratedCamera(exact)

    def _other_size(self, name: str, camera: Camera) -> str | None:
        """What speaks for a calibration with pictures of another size, where it states none."""
        size = np.array([camera.width, camera.height])
        off = np.abs(camera.canonical[2:4] / size - 0.5).max()
        if off < _FAR_OFF_CENTER or name not in self.sizeless:
            return None
        cx, cy = camera.canonical[2:4]
        return (
            f"the calibration states no image size, and its principal point ({cx:.0f}, {cy:.0f}) is far from the "
            f"middle of {camera.width}x{camera.height} pixels: if it is of another size, write width and height into it"
        )

    def _check_not_of_upright(self, camera: Camera, photograph: str, sideways: Collection[int]) -> None:
        for orientation in sideways:
            fault = fault_of_upright(camera, orientation, f"as {photograph} has them")
            if fault is not None:
                raise InputError(f"{self.place}: {fault[0]}", f"give --camera {camera.model.name},{fault[1]}")

    def _misshapen(self, own: Size, photograph: Photograph) -> InputError:
        (width, height), (own_width, own_height) = photograph.size, own
        advice = "give the photographs as the camera wrote them, or calibrate with pictures that were cut likewise"
        if _has_shape(own, photograph.size[::-1]):
            advice = (
                "one of them was turned: give the photographs, or calibrate with pictures, as the camera wrote them"
            )
        return InputError(
            f"{self.place}: expected a camera for pictures of the shape of {photograph.name}, {width}x{height} pixels, "
            f"found one for {own_width}x{own_height}",
            advice,
        )


def read_given_cameras(given: str) -> GivenCameras:
    """The cameras of ``MODEL,PARAMETER,...``, of a calibration file of any form that
    :func:`sfmapp.camera_files.reading.read_calibration` knows, or of a folder that holds one.

    Raises:
        InputError: the file cannot be read, or holds no camera.
        UsageError: neither a file nor a camera.
    """
    if not is_calibration_path(given):
        return GivenCameras(f"camera {given}", {"": lambda size: CalibratedCamera(camera_from_text(given, size))}, {""})
    fields = read_fields(Path(given))
    cameras: dict[str, CameraAt] = {}
    sizeless: set[str] = set()
    of_image: dict[str, str] = {}
    for name, section in cameras_in(given, fields).items():
        place = f"{given}: {name}" if name else given
        cameras[name] = partial(camera_of_fields, place, section)
        of_image |= dict.fromkeys(section.get("files", ()), name)
        if stated_size(place, section) is None:
            sizeless.add(name)
    return GivenCameras(given, cameras, sizeless, of_image)


def _has_shape(own: Size, size: Size) -> bool:
    """Whether pictures of one size are the others scaled, to the pixel that rounding may add."""
    return abs(own[1] * size[0] / own[0] - size[1]) <= 1.0


def _tail(name: str) -> tuple[str, ...]:
    """The parts of a name from the last to the first, the last without its ending."""
    path = PurePosixPath(name)
    return (path.stem, *reversed(path.parent.parts))


def _by_tail(of_image: Mapping[str, str]) -> dict[str, list[tuple[tuple[str, ...], str]]]:
    """Tails of images and their cameras, by the last part."""
    found: defaultdict[str, list[tuple[tuple[str, ...], str]]] = defaultdict(list)
    for name, camera in of_image.items():
        tail = _tail(name)
        found[tail[0]].append((tail, camera))
    return found


def _of_image(by_tail: Mapping[str, list[tuple[tuple[str, ...], str]]], name: str) -> str | None:
    """The camera of the image that a name is of, as far as both go; None if there is none, or several."""
    tail = _tail(name)
    cameras = {camera for other, camera in by_tail.get(tail[0], ()) if all(map(str.__eq__, tail, other))}
    return next(iter(cameras)) if len(cameras) == 1 else None
