"""Frames of a sequence as photographs: each is decoded once where they are asked for in order, few lie in memory, and
what is gone or has another name is no picture."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import sfmapp
from sfmapp.errors import InputError
from sfmapp.images.sequence import Frame
from sfmapp.images.sequence_source import MAX_HELD, SequenceSource

CAMERA = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, 20, 10, [9.0, 9.0, 10.0, 5.0])
COUNT = 100


class Counted(sfmapp.ArraySequence):
    """A hundred frames, each of one brightness, some of them unreadable; counts how often they are played."""

    def __init__(self, unreadable: tuple[int, ...] = ()) -> None:
        super().__init__([np.full((10, 20), k, np.uint8) for k in range(COUNT)], CAMERA)
        self.unreadable, self.walks, self.decoded = unreadable, 0, 0

    def frames(self) -> Iterator[Frame]:
        self.walks += 1
        for frame in super().frames():
            self.decoded += 1
            if frame.idx not in self.unreadable:
                yield frame


def every(step: int) -> dict[int, str]:
    return {k: f"{k:06d}" for k in range(0, COUNT, step)}


def test_in_order_and_from_threads_each_frame_is_decoded_once() -> None:
    sequence = Counted()
    with SequenceSource(sequence, every(3)) as source:
        assert source.names == list(every(3).values())
        with ThreadPoolExecutor(4) as pool:
            shown = list(pool.map(source.pixels, source.names))
    assert [int(image[0, 0]) for image in shown] == list(range(0, COUNT, 3))
    assert (sequence.walks, sequence.decoded, source.num_found) == (1, COUNT, 34)
    assert source.mask("000003") is None


def test_any_order_is_right_and_few_frames_are_held() -> None:
    sequence = Counted()
    source = SequenceSource(sequence, every(1))
    assert int(source.pixels("000099")[0, 0]) == 99
    assert len(source._held) <= MAX_HELD
    for k in (98, 0, 99, 99, 50):
        assert int(source.pixels(f"{k:06d}")[0, 0]) == k
        assert len(source._held) <= MAX_HELD
    assert sequence.walks <= 4


def test_frames_that_are_gone_do_not_have_the_rest_read_again() -> None:
    sequence = Counted(unreadable=(10, 50, 99))
    source = SequenceSource(sequence, every(1))
    for name in source.names:
        if int(name) in sequence.unreadable:
            with pytest.raises(InputError, match=f"expected a frame {name}, found none"):
                source.pixels(name)
        else:
            assert int(source.pixels(name)[0, 0]) == int(name)
    assert (sequence.walks, source.num_found, source.renamed) == (1, COUNT - 3, None)


def test_a_frame_of_another_name_is_told_and_refused() -> None:
    source = SequenceSource(Counted(), {3: "000003", 7: "walk/000007.png"})
    assert int(source.pixels("000003")[0, 0]) == 3
    with pytest.raises(InputError, match="found none"):
        source.pixels("walk/000007.png")
    assert source.renamed == (7, "walk/000007.png", "000007")
