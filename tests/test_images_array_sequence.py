"""Frames in memory: what is played, what is refused, and a run on them with and without a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from odometry_sequences import PINHOLE, room, room_rig
from sfmapp.images.sequence import Frame
from sfmapp.scene.rig import Rig

SMALL = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, 60, 40, [50.0, 50.0, 30.0, 20.0])


def noise(*shape: int, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def played(*args: object, **more: object) -> list[Frame]:
    return list(sfmapp.ArraySequence(*args, **more).frames())  # type: ignore[arg-type]


def test_colour_is_read_as_from_files_and_deep_grey_keeps_its_brightness() -> None:
    import cv2

    rgb = noise(40, 60, 3)
    (frame,) = played([rgb], SMALL)
    np.testing.assert_array_equal(frame.images[0], cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    deep = [np.full((40, 60), 4095, np.uint16), np.full((40, 60), 2048, np.uint16)]
    bright, dark = played(deep, SMALL)
    assert bright.images[0][0, 0] == 255
    assert dark.images[0][0, 0] == 128


def test_times_are_those_given_or_come_from_the_rate() -> None:
    images = [noise(40, 60)] * 3
    assert [frame.timestamp_s for frame in played(images, SMALL, fps=10)] == pytest.approx([0.0, 0.1, 0.2])
    frames = played(images, SMALL, timestamps_s=iter([5.0, 5.5, 7.0]))
    assert [frame.timestamp_s for frame in frames] == [5.0, 5.5, 7.0]
    assert [frame.name for frame in frames] == ["000000", "000001", "000002"]
    for times in ([1.0, 1.0, 2.0], [1.0, 0.5, 2.0], [1.0, 2.0], [0.0, np.nan, 1.0]):
        with pytest.raises(sfmapp.InputError, match="expected a time after"):
            played(images, SMALL, timestamps_s=times)
    with pytest.raises(sfmapp.UsageError, match="fps"):
        sfmapp.ArraySequence(images, SMALL, fps=0.0)


def test_a_buffer_that_is_used_again_does_no_harm() -> None:
    buffer = np.zeros((40, 60), np.uint8)

    def grab() -> Iterator[np.ndarray]:
        for value in (1, 2, 3):
            buffer[:] = value
            yield buffer

    sequence = sfmapp.ArraySequence(grab(), SMALL)
    assert sequence.num_frames is None
    assert [frame.images[0][0, 0] for frame in list(sequence.frames())] == [1, 2, 3]
    with pytest.raises(sfmapp.InputError, match="read only once"):
        next(sequence.frames())
    again = sfmapp.ArraySequence([buffer], SMALL)
    assert len(list(again.frames())) == len(list(again.frames())) == again.num_frames == 1


def test_wrong_frames_are_refused_by_name() -> None:
    pair = Rig((SMALL, SMALL), room_rig(True).cam_from_rig)
    assert len(played([(noise(40, 60), noise(40, 60))], pair)[0].images) == 2
    with pytest.raises(sfmapp.InputError, match="frame 000001: 61x40 pixels"):
        played([noise(40, 60), noise(40, 61)], SMALL)
    with pytest.raises(sfmapp.InputError, match="frame 000000: expected 2 images, found 1"):
        played([noise(40, 60)], pair)
    with pytest.raises(sfmapp.InputError, match="frame 000000: expected pixels"):
        played([noise(40, 60).astype(float)], SMALL)


def test_the_same_poses_with_and_without_a_folder(tmp_path: Path) -> None:
    images = [images[0] for images in room(30).images]
    seen = []
    events = sfmapp.Events()
    in_memory, report = sfmapp.track_sequence(
        sfmapp.ArraySequence(iter(images), PINHOLE), on_frame=seen.append, events=events, threads=1, seed=3
    )
    assert report is None
    assert len(seen) == 30
    np.testing.assert_array_equal([frame.cam_from_world for frame in seen], in_memory.live_cam_from_world)
    assert len(in_memory.maps[0].reconstruction.points) > 100
    sequence = sfmapp.ArraySequence(images, PINHOLE)
    written, _ = sfmapp.track_sequence(sequence, tmp_path / "track", record=False, threads=2, seed=3)
    assert written.cam_from_world.tobytes() == in_memory.cam_from_world.tobytes()
    keyframes = sfmapp.load(tmp_path / "track")
    assert [image.name for image in keyframes.images] == written.maps[0].reconstruction.image_names
    assert written.maps[0].reconstruction.point_rgb.tobytes() == in_memory.maps[0].reconstruction.point_rgb.tobytes()
    options = sfmapp.load_options(settings=["scale.source=distance:0:29:2.5"])
    metric, _ = sfmapp.track_sequence(sequence, options=options, events=events, threads=1, seed=3)
    assert len(seen) == 30  # who heard of the frames of one call hears nothing of the next
    first, last = (sfmapp.Rigid3(metric.cam_from_world[k]).center for k in (0, -1))
    assert np.linalg.norm(last - first) == pytest.approx(2.5)
    assert metric.maps[0].scale_source == "distance"
    with pytest.raises(sfmapp.UsageError, match="needs a folder"):
        sfmapp.track_sequence(tmp_path)
    with pytest.raises(sfmapp.UsageError, match="come with their camera"):
        sfmapp.track_sequence(sequence, tmp_path / "again", self_calibrate=True)
