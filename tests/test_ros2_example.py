"""The node of ROS 2 in the examples, with as much of rclpy as it asks for."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from odometry_sequences import PINHOLE, room

NODE = Path(__file__).resolve().parent.parent / "examples" / "ros2" / "odometry_node.py"


class FakeNode:
    """What is published, what is logged, and who listens to which topic; ``made``: all nodes."""

    made: list[FakeNode] = []  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.made.append(self)
        self.published: list[Any] = []
        self.warnings: list[str] = []
        self.listeners: dict[str, Any] = {}

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: object) -> None:
        self.listeners[topic] = callback

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.warnings.append)


class FakeTime:
    def __init__(self, nanoseconds: int) -> None:
        self.nanoseconds = nanoseconds

    @classmethod
    def from_msg(cls, message: SimpleNamespace) -> FakeTime:
        return cls(message.sec * 10**9 + message.nanosec)

    def to_msg(self) -> SimpleNamespace:
        return SimpleNamespace(sec=self.nanoseconds // 10**9, nanosec=self.nanoseconds % 10**9)


def pose_stamped() -> SimpleNamespace:
    return SimpleNamespace(
        header=SimpleNamespace(),
        pose=SimpleNamespace(orientation=SimpleNamespace(), position=SimpleNamespace()),
    )


def image_message(number: int, pixels: np.ndarray, encoding: str = "mono8") -> SimpleNamespace:
    seconds, rest = divmod(round((5.0 + number / 30) * 1e9), 10**9)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=rest), frame_id="camera")
    return SimpleNamespace(
        header=header, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, is_bigendian=0,
        step=pixels.shape[1], data=pixels.tobytes(),
    )  # fmt: skip


def test_images_come_in_and_poses_go_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    images = [images[0] for images in room(30).images]
    fx, fy, cx, cy = PINHOLE.params
    info = SimpleNamespace(
        p=[fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1, 0], width=PINHOLE.width, height=PINHOLE.height
    )
    FakeNode.made.clear()

    def play() -> Any:
        (node,) = FakeNode.made
        node.listeners["image"](image_message(0, images[0]))  # before its camera is known
        node.listeners["camera_info"](info)
        node.listeners["camera_info"](info)
        yield
        for number, image in enumerate(images, 1):
            node.listeners["image"](image_message(number, image))
            while node.odometry.report.num_tracked < number:  # type: ignore[attr-defined]
                yield
        node.listeners["image"](image_message(len(images), images[0]))  # a stamp that does not ascend
        node.listeners["image"](image_message(99, images[0], "unheard_of"))
        raise KeyboardInterrupt

    steps = play()
    fakes = {
        "rclpy": {"init": lambda **_: None, "shutdown": lambda: None, "spin_once": lambda *_, **__: next(steps)},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "rclpy.time": {"Time": FakeTime},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseStamped": pose_stamped},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CameraInfo": object, "Image": object},
    }  # fmt: skip
    for name, members in fakes.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(NODE), run_name="__main__")
    assert capsys.readouterr().out == "30 of 30 frames have a pose, 0 were dropped\n"
    (node,) = FakeNode.made
    assert [text.partition(":")[0] for text in node.warnings] == ["an image is left out"] * 2
    last = node.published[-1]
    assert last.header.frame_id == "map0"
    assert last.header.stamp.sec + 1e-9 * last.header.stamp.nanosec == pytest.approx(5.0 + 30 / 30)
    quaternion = [getattr(last.pose.orientation, axis) for axis in "xyzw"]
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert (tmp_path / "track" / "trajectory.tum").is_file()
