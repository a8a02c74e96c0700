"""Where the camera is expected in the next frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.gyroscope import GyroTrust, imu_rotation

Array = NDArray[np.float64]

# Frames are taken to come at a steady rate within this share of the time between them.
_STEADY_SHARE, _MAX_STEADY_SHARE = 0.2, 3.0


class MotionModel:
    """A steady motion, over the time that passes; turned as the gyroscope says where that has told turns better.

    Attributes:
        step: (7,) the last motion from one frame to the next, in the unit of the current map.
    """

    def __init__(self, imu: Imu | None) -> None:
        self.step: Array = rigid3.IDENTITY
        self._imu, self._trust = imu, GyroTrust()
        # (3, 3) turns since the last frame, by the gyroscope and if the motion is steady
        self._foretold: tuple[Array, Array] | None = None

    def predict(self, timestamps_s: Sequence[float]) -> Array:
        """The motion (7,) into the newest frame.

        Args:
            timestamps_s: of the newest frames, three of them if there are as many.
        """
        self._foretold = None
        if len(timestamps_s) < 3:
            return self.step
        before, last, now = timestamps_s
        # after a pause nobody knows: what has moved on so far would be nearly out of sight
        share = min(round((now - last) / (last - before), 2), _MAX_STEADY_SHARE)
        is_steady = abs(share - 1) <= _STEADY_SHARE
        step = self.step if is_steady else rigid3.interpolate(rigid3.IDENTITY, self.step, share)
        turn = None if self._imu is None else imu_rotation(self._imu, last, now)
        self._foretold = None if turn is None else (turn, rigid3.rotation_matrix(step))
        if turn is None or not self._trust.is_better:
            return step
        return rigid3.from_matrix(self._trust.corrected(turn), step[4:])

    def learn(self, step: Array) -> None:
        """Note the motion (7,) that was measured after :meth:`predict`."""
        self.step = step
        if self._foretold is not None:
            self._trust.learn(*self._foretold, rigid3.rotation_matrix(step))

    def stop(self) -> None:
        """Nothing is known of the motion any more."""
        self.step = rigid3.IDENTITY

    def rescale(self, scale: float) -> None:
        """The unit of the map has changed: lengths are multiplied by this."""
        self.step = self.step * np.repeat([1.0, scale], [4, 3])
