"""From what the user points at to a sequence: recognise the layout, find the cameras, put time in order."""

from __future__ import annotations

import glob
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.fields import camera_from_text, is_calibration_path, oddity
from sfmapp.camera_files.opencv_lens import sampling_map
from sfmapp.camera_files.reading import Calibration, read_calibration
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.bags import is_bag
from sfmapp.formats.clocks import Times, are_dates
from sfmapp.formats.trajectory_input import read_trajectory
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import INVERSE, is_sideways, upright_size
from sfmapp.images.bag_sequence import BagSequence
from sfmapp.images.containers import shown
from sfmapp.images.exif import ExifFacts, focal_prior, read_exif
from sfmapp.images.frame_reader import FileSequence, read_regular_file, some
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.sequence import STAGE, GroundTruth, Imu, Sequence, SequenceOptions
from sfmapp.images.sources import EXTENSIONS, printable
from sfmapp.images.video import DEFAULT_FPS, VideoSequence, is_stream, read_video_facts
from sfmapp.scene.rig import Rig
from sfmapp.scene.turned_camera import fault_of_upright, turned_camera
from sfmapp.sequences.bags import read_bag_sequence
from sfmapp.sequences.euroc import euroc_ground_truth, find_mav, read_euroc_sequence, read_imu
from sfmapp.sequences.files import (
    Recording,
    Size,
    ascending,
    frame_numbers,
    has_images,
    rows_of_frames,
)
from sfmapp.sequences.kitti import FRAMES_PER_SECOND as KITTI_FPS
from sfmapp.sequences.kitti import is_kitti, read_kitti_sequence
from sfmapp.sequences.plain import (
    find_calibration,
    find_pair,
    read_folder_sequence,
    read_listed_sequence,
    read_pair_sequence,
)
from sfmapp.sequences.tum import is_tum, read_tum_sequence, tum_ground_truth

__all__ = ["MissingCameraError", "SequenceOptions", "open_sequence"]

Array = NDArray[np.float64]

# Files of a sequence that users point at instead of its folder.
_LISTS = frozenset({"rgb.txt", "data.csv", "times.txt", "timestamps.txt", "calib.txt", "calib.json", "poses.txt"})
# Where frames lie that do not lie in the folder itself.
_FRAME_FOLDERS = ("images", "frames", "rgb", "color", "image", "img", "imgs", "data", "input", "undistorted")
# Nothing that moves carries cameras further apart; a calibration in millimetres says that it does.
_WIDEST_BASELINE_M = 10.0
_LAYOUTS = (
    "a folder with images; image_0 and calib.txt (KITTI); rgb.txt and rgb (TUM); mav0 or cam0/data (EuRoC); "
    "left and right; a video; or a bag of ROS 1 (.bag), ROS 2 (metadata.yaml) or MCAP"
)
_LABELS = {"kitti": "KITTI", "tum": "TUM RGB-D", "euroc": "EuRoC", "folder": "images"}
HOW_TO_CALIBRATE = (
    "give --camera PINHOLE,fx,fy,cx,cy or --camera FILE (calib.json, cameras.txt, sensor.yaml, camera_info.yaml, "
    "OpenCV's yml or xml), to be had from photographs or a video of a chessboard by sfmapp calibrate board; or let "
    "--self-calibrate find the focal length from the first minute"
)


class MissingCameraError(InputError):
    """Nothing tells the intrinsics of the camera. ``open_sequence(..., require_camera=False)`` goes on without."""


def open_sequence(
    source: str | Path, options: SequenceOptions, events: Events, *, require_camera: bool = True,
    look_beside: bool = True,
) -> Sequence:  # fmt: skip
    """Open a sequence; nothing is decoded yet but the first frame of a video.

    Args:
        source: a folder of KITTI, TUM or EuRoC, a folder of images, one with ``left`` and ``right``, a glob pattern, a
            list of images, a video file, a bag of ROS 1 or 2, an MCAP file, a URL, or ``camera:0``.
        options: what to play of it, and what it does not say itself.
        events: told what was recognised and assumed, and, while frames are read, what is left out.
        require_camera: False: where nothing tells the intrinsics, the rig has one SIMPLE_RADIAL camera with a focal
            length from EXIF or a guess (``focal_source`` is ``default`` or begins with ``exif``).
        look_beside: False: a calibration file that merely lies beside the frames is not read.

    Raises:
        MissingCameraError: nothing tells the intrinsics, and they are required.
        InputError: no sequence is there, or a file of it is not what it should be.
        UsageError: options that cannot be obeyed.
    """
    text = str(source)
    if "\0" in text:
        raise InputError(f"{printable(text)}: expected a sequence, found a name that no file can have")
    try:
        return _open(text, options, events, require_camera, look_beside)
    except OSError as error:
        raise InputError(f"{printable(text)}: cannot be read: {error}") from error


def _open(text: str, options: SequenceOptions, events: Events, require_camera: bool, look_beside: bool) -> Sequence:
    path = Path(text)
    if path.exists() and is_bag(path):
        recording = read_bag_sequence(path, options, events)
        return _sequence(text, recording, options, events, require_camera, look_beside)
    if options.image_topic is not None or options.imu_topic is not None:
        raise UsageError(f"topics are of bags, which {printable(text)} is not")
    if is_stream(text):
        return _open_video(text, options, events, require_camera, look_beside)
    if not path.exists():
        if not glob.has_magic(text):
            raise InputError(f"{printable(text)}: expected a sequence, found nothing", f"a sequence is {_LAYOUTS}")
        return _sequence(text, read_listed_sequence(text), options, events, require_camera, look_beside)
    if path.is_file() and path.name not in _LISTS:
        if path.suffix.lower() in EXTENSIONS:
            raise InputError(f"{path}: expected a sequence, found a single image", f"a sequence is {_LAYOUTS}")
        if path.suffix.lower() == ".txt":
            return _sequence(text, read_listed_sequence(text), options, events, require_camera, look_beside)
        return _open_video(text, options, events, require_camera, look_beside)
    folder = (path.parent if path.is_file() else path).absolute()
    return _sequence(text, _read_layout(folder, events), options, events, require_camera, look_beside)


def _read_layout(folder: Path, events: Events) -> Recording:
    """What lies in a folder, whichever layout it has."""
    inside, above = folder.name, folder.parent
    mav = find_mav(folder)
    if mav is not None:
        return read_euroc_sequence(mav, events)
    if inside == "data" and above.name in ("cam0", "cam1"):
        return read_euroc_sequence(above.parent, events, above.name)
    if inside in ("cam0", "cam1") and (folder / "data").is_dir():
        return read_euroc_sequence(above, events, inside)
    if is_kitti(folder):
        return read_kitti_sequence(folder, events)
    if inside in ("image_0", "image_1", "image_2", "image_3") and has_images(folder):
        return read_kitti_sequence(above, events, inside)
    if is_tum(folder) or (inside == "rgb" and is_tum(above)):
        return read_tum_sequence(folder if is_tum(folder) else above, events)
    pair = find_pair(folder)
    if pair is not None:
        return read_pair_sequence(folder, *pair, events)
    if has_images(folder):
        # what belongs to a folder called images or left lies beside it
        is_part = inside in _FRAME_FOLDERS and not has_images(above)
        return read_folder_sequence(above if is_part else folder, folder)
    within = [folder / name for name in _FRAME_FOLDERS if has_images(folder / name)]
    if not within:
        within = sorted(path for path in folder.iterdir() if path.is_dir() and has_images(path))
        if len(within) > 1:
            names = [printable(path.name) for path in within]
            raise InputError(f"{folder}: expected one sequence, found folders of images: {some(names)}", "name one")
    if within:
        return read_folder_sequence(folder, within[0])
    found = some(sorted(printable(path.name) for path in folder.iterdir())) or "nothing"
    raise InputError(f"{folder}: expected a sequence, found {found}", f"a sequence is {_LAYOUTS}")


# ---------------------------------------------------------------------------------------------------------- cameras


def _calibration(
    given: str | None,
    folders: list[Path],
    own: Calibration | None,
    is_published: bool,
    sizes: tuple[Size, ...],
    orientation: int = 1,
) -> Calibration | None:
    """The user's calibration, else the layout's own, else a file beside the frames (before a published one)."""
    if given is not None:
        if is_calibration_path(given):
            chosen = _read_calibration(given, sizes, orientation)
        else:
            camera = camera_from_text(given, sizes[0])
            _check_not_of_upright(f"camera {given}", camera, orientation)
            chosen = Calibration(Rig.single(camera))
        # a text gives intrinsics only; where the body is, is still known
        if chosen.body_from_cam is None and own is not None:
            chosen = replace(chosen, body_from_cam=own.body_from_cam)
        return chosen
    if own is not None and not is_published:
        return own
    beside = find_calibration(*folders)
    return own if beside is None else _read_calibration(beside, sizes, orientation)


def _read_calibration(path: str | Path, sizes: tuple[Size, ...], orientation: int) -> Calibration:
    """A calibration in pixels as the files store them; one for pictures that EXIF's orientation has turned is turned
    back."""
    try:
        calibration = read_calibration(path, sizes)
    except InputError as error:
        if not is_sideways(orientation) or len(sizes) > 1:
            raise
        try:
            turned = read_calibration(path, [upright_size(orientation, *sizes[0])])
        except InputError:
            raise error from None
        if turned.body_from_cam is not None or turned.lenses[0] is not None:
            raise
        camera = turned_camera(turned.rig.cameras[0], INVERSE[orientation])
        note = f"{path}: made with pictures turned upright as EXIF says, turned back to the pixels of the files"
        return replace(turned, rig=Rig.single(camera), notes=(*turned.notes, note))
    _check_not_of_upright(str(path), calibration.rig.cameras[0], orientation)
    return calibration


def _check_not_of_upright(what: str, camera: Camera, orientation: int) -> None:
    fault = fault_of_upright(camera, orientation, "as the files store them")
    if fault is not None:
        raise InputError(f"{what}: {fault[0]}", f"give --camera {camera.model.name},{fault[1]}")


def _guessed_camera(size: Size, first: Path | None) -> Camera:
    """What EXIF or experience says of a camera that nothing else is known of."""
    prior = focal_prior(_exif_of(first), *size)
    return simple_camera(CameraModel.SIMPLE_RADIAL, *size, prior.focal_px, prior.sigma_px, prior.source)


def _exif_of(first: Path | None) -> ExifFacts:
    if first is not None:
        with suppress(UnusableImage):
            return read_exif(read_header(read_regular_file(first)).exif)
    return ExifFacts()


def _rig(
    what: str, calibration: Calibration | None, sizes: tuple[Size, ...], first: Path | None, events: Events,
    require_camera: bool,
) -> Rig:  # fmt: skip
    """The cameras that are played: both where both are calibrated and wanted."""
    if calibration is None:
        width, height = sizes[0]
        if require_camera:
            raise MissingCameraError(
                f"{what}: expected the intrinsics of its camera ({width}x{height} pixels), found no calibration in it",
                HOW_TO_CALIBRATE,
            )
        camera = _guessed_camera(sizes[0], first)
        events.decided(
            STAGE,
            f"no calibration: a focal length of {camera.focal:.0f} px is assumed at first",
            focal_px=camera.focal, focal_source=camera.focal_source,
        )  # fmt: skip
        return Rig.single(camera)
    for note in calibration.notes:
        events.decided(STAGE, note)
    rig = calibration.rig if len(sizes) > 1 else Rig.single(calibration.rig.cameras[0])
    if len(sizes) > 1 and not rig.is_stereo:
        events.warned(STAGE, f"{what}: images of two cameras, but no calibration of the pair: the first is used alone")
    if rig.is_stereo and np.linalg.norm(rig.cam_from_rig[1, 4:]) > _WIDEST_BASELINE_M:
        baseline = np.linalg.norm(rig.cam_from_rig[1, 4:])
        events.warned(STAGE, f"{what}: the cameras of the pair are {baseline:.0f} m apart: are lengths in millimetres?")
    for camera in rig.cameras:
        if odd := oddity(camera):
            events.warned(STAGE, f"{what}: {odd}")
    return rig


def _sampling(rig: Rig, calibration: Calibration | None) -> tuple[NDArray[np.float32] | None, ...]:
    lenses = calibration.lenses if calibration else (None,)
    return tuple(sampling_map(camera, lens) for camera, lens in zip(rig.cameras, lenses, strict=False))


# ------------------------------------------------------------------------------------------------------ what is played


def _sequence(
    source: str, recording: Recording, options: SequenceOptions, events: Events, require_camera: bool,
    look_beside: bool,
) -> FileSequence:  # fmt: skip
    """The wishes of the user applied to what a layout holds."""
    if options.reverse and recording.bag is not None:
        raise UsageError("reverse is not possible with a bag", "write its images to a folder first")
    first = [frame[0] for frame in recording.paths]
    folders = [recording.root, first[0].parent, *([recording.root.parent] if recording.kind == "euroc" else [])]
    folders = folders if look_beside else []
    sizes = recording.sizes[:1] if options.mono else recording.sizes
    orientation = 1 if recording.bag is not None else _exif_of(first[0]).orientation
    calibration = _calibration(
        options.camera, folders, recording.calibration, recording.kind == "tum", sizes, orientation
    )
    rig = _rig(source, calibration, sizes, first[0], events, require_camera)
    clock = _clock(recording, first, options, calibration, events)
    times, elapsed = clock.frames_s, clock.elapsed_s
    body_from_cam = calibration.body_from_cam if calibration else None
    ground_truth = clock.moved(
        _ground_truth(recording, options.ground_truth, clock.own_s, first, body_from_cam, events)
    )
    _warn_of_foreign_ground_truth(ground_truth, times, events)
    imu = _imu(recording, options, clock, body_from_cam, events)
    kept = _in_order(recording, times, events)
    played = kept[options.start : options.stop : options.step]
    if not len(played):
        raise InputError(f"{source}: expected frames from {options.start} to {options.stop}, found {len(kept)} in all")
    if options.reverse:
        played, times, elapsed, ground_truth, imu = _mirrored(played, times, elapsed, ground_truth, imu)
    fps = 1 / float(np.median(np.diff(times[played]))) if len(played) > 1 else clock.frames_per_second
    bag = None if recording.bag is None else replace(recording.bag, positions=recording.bag.positions[played])
    make = FileSequence if bag is None else partial(BagSequence, bag=bag)
    sequence = make(
        recording.kind,
        source,
        rig,
        [recording.names[i] for i in played],
        times[played],
        [recording.paths[i][: len(rig.cameras)] for i in played],
        _sampling(rig, calibration),
        fps,
        imu,
        ground_truth,
        events,
        None if elapsed is None else elapsed[played],
        orientation,
    )
    _tell(sequence, events)
    return sequence


def _in_order(recording: Recording, times: Array, events: Events) -> NDArray[np.int64]:
    """Positions of the frames whose times ascend; the others are named."""
    kept = ascending(times)
    if len(kept) < len(times):
        lost = np.setdiff1d(np.arange(len(times)), kept)
        names = [recording.names[i] for i in lost]
        text = f"{len(names)} of {len(times)} frames are skipped, whose times do not ascend: {some(names)}"
        events.warned(STAGE, text, names=names)
    return kept


@dataclass(frozen=True)
class _Clock:
    """When the frames were taken.

    Attributes:
        frames_s: (N,) seconds that they are played with.
        own_s: (N,) what the sequence says, which ground truth and IMU go by; the same array unless a rate was given
            instead.
        frames_per_second: the rate that they were made from; None where they were not.
        own: the sequence's times where they are played as they are; None otherwise.
    """

    frames_s: Array
    own_s: Array
    frames_per_second: float | None = None
    own: Times | None = None

    @property
    def elapsed_s(self) -> Array | None:
        """(N,) see :class:`~sfmapp.images.sequence.Frame`."""
        return None if self.own is None else self.own.elapsed_s

    def moved(self, ground_truth: GroundTruth | None) -> GroundTruth | None:
        """Poses at times of the sequence's own clock at those that are played; all others as they are."""
        order = ascending(self.own_s)
        if ground_truth is None or self.own_s is self.frames_s or not len(ground_truth.timestamps_s) or len(order) < 2:
            return ground_truth
        if _share_time(ground_truth, self.frames_s) or not _share_time(ground_truth, self.own_s):
            return ground_truth
        own, played = self.own_s[order], self.frames_s[order]
        inside = (ground_truth.timestamps_s >= own[0]) & (ground_truth.timestamps_s <= own[-1])
        return GroundTruth(
            np.interp(ground_truth.timestamps_s[inside], own, played), ground_truth.cam_from_world[inside]
        )


def _share_time(ground_truth: GroundTruth, times: Array) -> bool:
    return bool(
        len(times) and times.min() <= ground_truth.timestamps_s[-1] and ground_truth.timestamps_s[0] <= times.max()
    )


def _clock(
    recording: Recording, first: list[Path], options: SequenceOptions, calibration: Calibration | None, events: Events
) -> _Clock:
    """Times as the user, else the files, else a rate tell them."""
    own = recording.times
    for note in (*((own.note,) if own is not None and own.note else ()), *recording.notes):
        events.decided(STAGE, note)
    if own is not None and options.fps is None:
        return _Clock(own.seconds, own.seconds, own=own)
    fps, reason = options.fps, "as given"
    if fps is None and calibration is not None and calibration.frames_per_second is not None:
        fps, reason = calibration.frames_per_second, "as the calibration says"
    if fps is None:
        fps = KITTI_FPS if recording.kind == "kitti" else DEFAULT_FPS
        reason = "KITTI's rate" if recording.kind == "kitti" else "assumed; --fps changes it"
    # numbers that are left out are time that went by
    numbers = frame_numbers(first)
    numbers = np.arange(len(first)) if numbers is None else numbers - numbers[0]
    why = "the frames have no times" if own is None else "the times of the sequence are not used"
    if own is None and are_dates([path.stem for path in first]):
        why = "the names of the frames are dates, which are not taken for times"
    events.decided(STAGE, f"{why}: {fps:g} frames a second ({reason})", frames_per_second=fps)
    times = numbers / fps
    return _Clock(times, times if own is None else own.seconds, fps)


def _imu(
    recording: Recording, options: SequenceOptions, clock: _Clock, body_from_cam: Array | None, events: Events
) -> Imu | None:
    """The user's IMU, or the sequence's own, unless a rate was given in place of the clock that the two share."""
    if options.imu is not None:
        return _given_imu(options.imu, body_from_cam, clock.own, events)
    if recording.imu is not None and clock.own_s is not clock.frames_s:
        events.warned(STAGE, "the IMU is not used: its clock is that of the sequence, which --fps replaces")
        return None
    if recording.imu is None or recording.bag is None:
        return recording.imu
    # what the user's calibration says goes before the bag's transforms
    imu_from_cam = recording.imu.imu_from_cam if body_from_cam is None else body_from_cam
    if np.isnan(imu_from_cam).any():
        text = "the IMU is not used: no /tf_static says where it is; --camera FILE can, a camchain.yaml with T_cam_imu"
        events.warned(STAGE, text)
        return None
    return replace(recording.imu, imu_from_cam=imu_from_cam)


def _ground_truth(
    recording: Recording,
    given: str | None,
    times: Array,
    first: list[Path],
    body_from_cam: Array | None,
    events: Events,
) -> GroundTruth | None:
    """The user's trajectory, or the one that lies beside the frames: of that one, nothing wrong stops the run."""
    ground_truth = recording.ground_truth
    beside = next((path for path in recording.ground_truth_paths if path.is_file()), None)
    if given is not None:
        ground_truth = _read_ground_truth(Path(given), times, first, body_from_cam, events)
    elif beside is not None:
        try:
            ground_truth = _read_ground_truth(beside, times, first, body_from_cam, events)
        except InputError as error:
            events.warned(STAGE, f"the ground truth is not used: {error}")
    return ground_truth if ground_truth is not None and len(ground_truth.timestamps_s) else None


def _warn_of_foreign_ground_truth(ground_truth: GroundTruth | None, times: Array, events: Events) -> None:
    if ground_truth is not None and len(ground_truth.timestamps_s) and not _share_time(ground_truth, times):
        span = f"{ground_truth.timestamps_s[0]:.3f} to {ground_truth.timestamps_s[-1]:.3f} s"
        text = (
            f"the ground truth is of {span}, the frames of {times.min():.3f} to {times.max():.3f} s: they share no time"
        )
        events.warned(STAGE, text)


def _read_ground_truth(
    path: Path, times: Array | None, first: list[Path], body_from_cam: Array | None, events: Events
) -> GroundTruth:
    """A trajectory of the first camera (TUM) or of the body (EuRoC; KITTI, whose body is its camera 0).

    ``times`` are those of the frames; None of a video, which are not known before it is read.
    """
    file = read_trajectory(path, like=times)
    if file.note:
        events.decided(STAGE, file.note)
    if file.format == "euroc":
        return euroc_ground_truth(file, body_from_cam)
    if file.format == "tum":
        return tum_ground_truth(file)
    poses = file.cam_from_world
    if times is None:
        raise InputError(
            f"{path}: expected a trajectory with timestamps, by which the frames of a video are matched, "
            "found KITTI's form",
            "write it as TUM has it: timestamp tx ty tz qx qy qz qw",
        )
    chosen = rows_of_frames(len(poses), first)
    if chosen is None:
        raise InputError(f"{path}: expected a pose for each of {len(first)} frames, found {len(poses)}")
    poses = poses[chosen]
    if body_from_cam is not None:
        poses = rigid3.compose(rigid3.inverse(body_from_cam), poses)
    order = [i for i in ascending(times) if np.isfinite(poses[i]).all()]
    return GroundTruth(times[order], poses[order])


def _given_imu(given: str, body_from_cam: Array | None, times: Times | None, events: Events) -> Imu:
    path = Path(given) / "data.csv" if Path(given).is_dir() else Path(given)
    if body_from_cam is None:
        raise InputError(
            f"{path}: expected the pose of the IMU (T_BS or T_cam_imu) in the camera's calibration, found none",
            "give --camera a sensor.yaml of EuRoC or a camchain.yaml of Kalibr, which hold it",
        )
    imu, note = read_imu(path, body_from_cam, times)
    if note:
        events.decided(STAGE, note)
    return imu


def _mirrored(
    played: NDArray[np.int64], times: Array, elapsed: Array | None, ground_truth: GroundTruth | None, imu: Imu | None
) -> tuple[NDArray[np.int64], Array, Array | None, GroundTruth | None, Imu | None]:
    """Everything backwards in time, on a clock that still ascends: t becomes first + last - t."""
    total = float(times[played[0]] + times[played[-1]])
    total_elapsed = 0.0 if elapsed is None else float(elapsed[played[0]] + elapsed[played[-1]])
    if ground_truth is not None:
        ground_truth = GroundTruth(total - ground_truth.timestamps_s[::-1], ground_truth.cam_from_world[::-1].copy())
    if imu is not None:
        # a rotation runs the other way round; an acceleration, the second derivative, is what it was
        back = total - imu.timestamps_s[::-1]
        back_elapsed = None if imu.elapsed_s is None else total_elapsed - imu.elapsed_s[::-1]
        imu = replace(
            imu, timestamps_s=back, gyro=-imu.gyro[::-1], accel=imu.accel[::-1].copy(), elapsed_s=back_elapsed
        )
    return played[::-1], total - times, None if elapsed is None else total_elapsed - elapsed, ground_truth, imu


def _open_video(
    source: str, options: SequenceOptions, events: Events, require_camera: bool, look_beside: bool
) -> VideoSequence:
    facts = read_video_facts(source)
    size = (facts.width, facts.height)
    folders = [Path(source).absolute().parent] if look_beside and not is_stream(source) else []
    calibration = _calibration(options.camera, folders, None, False, (size,))
    rig = _rig(shown(source), calibration, (size,), None, events, require_camera)
    body_from_cam = calibration.body_from_cam if calibration else None
    imu = _given_imu(options.imu, body_from_cam, None, events) if options.imu is not None else None
    ground_truth = None
    if options.ground_truth is not None:
        ground_truth = _read_ground_truth(Path(options.ground_truth), None, [], body_from_cam, events)
    sequence = VideoSequence(source, rig, facts, options, events, _sampling(rig, calibration), imu, ground_truth)
    _tell(sequence, events)
    return sequence


def _tell(sequence: Sequence, events: Events) -> None:
    camera = sequence.rig.cameras[0]
    count = "frames" if sequence.num_frames is None else f"{sequence.num_frames} frames"
    baseline = float(np.linalg.norm(sequence.rig.cam_from_rig[-1, 4:]))
    parts = [
        _LABELS.get(sequence.kind, sequence.kind),
        f"{count} of {camera.width}x{camera.height}",
        f"stereo, {100 * baseline:.1f} cm apart" if sequence.rig.is_stereo else "one camera",
        f"{sequence.frames_per_second:.4g} a second" if sequence.frames_per_second else "of unknown rate",
        f"{camera.model.name}, f {camera.focal:.1f} px",
    ]
    parts += ["IMU"] if sequence.imu is not None else []
    parts += ["ground_truth"] if sequence.ground_truth is not None else []
    if sequence.orientation != 1:
        text = "the frames have an EXIF orientation: they are used as they are stored, which a calibration has to fit"
        events.decided(STAGE, text, orientation=sequence.orientation)
    events.decided(
        STAGE,
        ", ".join(parts),
        kind=sequence.kind,
        num_frames=sequence.num_frames,
        frames_per_second=sequence.frames_per_second,
        num_cameras=len(sequence.rig.cameras),
        baseline_m=baseline if sequence.rig.is_stereo else None,
        has_imu=sequence.imu is not None,
        has_ground_truth=sequence.ground_truth is not None,
    )
