"""Inertial measurements that a program pushes as they come: checked, kept for a while, and told to whoever listens."""

from __future__ import annotations

import itertools
import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError
from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]

# A frame that is tracked has been waiting for less than that, and what is begun with is older by seconds.
KEPT_S = 60.0


class ImuStream:
    """Measurements one by one, from any thread; each is told to the listeners in the thread that pushes. Those of the
    last minute are kept.

    Args:
        sensor: how it is mounted and how noisy it is. Measurements that it has are the first ones.

    Raises:
        InputError: a mounting or noises that are none.
    """

    def __init__(self, sensor: Imu) -> None:
        noises = np.array([sensor.gyro_noise, sensor.accel_noise, sensor.gyro_walk, sensor.accel_walk])
        if not (np.isfinite(noises).all() and (noises > 0.0).all()):
            raise InputError(f"IMU: expected noise densities and walks above zero, found {noises.tolist()}")
        mounting = np.asarray(sensor.imu_from_cam, np.float64)
        if mounting.shape != (7,) or not abs(float(np.linalg.norm(mounting[:4])) - 1.0) < 1e-6:
            raise InputError(
                f"IMU: expected imu_from_cam as (7,), a unit quaternion x y z w and a translation in metres, "
                f"found {mounting.tolist()}"
            )
        self._sensor = sensor
        self._lock = threading.Lock()
        self._kept = deque[Array]()
        self._last_s = -math.inf
        self._listeners: list[Callable[[], None]] = []
        measured = zip(sensor.timestamps_s, sensor.gyro, sensor.accel, strict=True)
        for row in measured:
            self.push(*row)

    def push(self, timestamp_s: float, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Add a sample; see :meth:`sfmapp.LiveOdometry.push_imu`."""
        numbers = [float(timestamp_s)]
        for name, unit, value in (("gyro", "rad/s", gyro), ("accel", "m/s^2", accel)):
            given = np.asarray(value, np.float64)
            if given.shape != (3,) or not np.isfinite(given).all():
                raise InputError(f"IMU: expected {name} as three finite numbers in {unit}, found {given.tolist()}")
            numbers += given.tolist()
        with self._lock:
            if not self._last_s < numbers[0] < math.inf:
                raise InputError(f"IMU: expected a time after {self._last_s:g} s, found {numbers[0]:g}")
            self._kept.append(np.array(numbers))
            self._last_s = numbers[0]
            while self._kept[0][0] < self._last_s - KEPT_S:
                self._kept.popleft()
        for listener in self._listeners:
            listener()

    def listen(self, listener: Callable[[], None]) -> None:
        """Have a function called after each sample."""
        self._listeners.append(listener)

    def after(self, timestamp_s: float) -> list[Array]:
        """Time, rates and forces (7,) of each sample that is kept and later than a moment, in order."""
        with self._lock:
            found = list(itertools.takewhile(lambda sample: sample[0] > timestamp_s, reversed(self._kept)))
        return found[::-1]

    def recorded(self) -> Imu:
        """All that are kept."""
        with self._lock:
            rows = np.array(self._kept).reshape(-1, 7)
        return replace(self._sensor, timestamps_s=rows[:, 0], gyro=rows[:, 1:4], accel=rows[:, 4:], elapsed_s=None)
