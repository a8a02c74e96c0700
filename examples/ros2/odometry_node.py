"""Odometry as a node of ROS 2: poses of a camera as they are found; frames that come too fast are dropped and counted.

    source /opt/ros/humble/setup.bash
    python examples/ros2/odometry_node.py --ros-args -r image:=/camera/image_rect -r camera_info:=/camera/camera_info

Needs rclpy, which ROS 2 brings, in a Python that has sfmapp. Images have to be rectified: their camera is P of
camera_info. Poses of the camera in the world go to the topic pose, in an arbitrary unit. After Ctrl-C the map is
adjusted once more and written to track/.
"""

import queue
import signal
import sys
import threading
from collections.abc import Iterator

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

import sfmapp
from sfmapp.formats.ros_messages import RawImage, Stamp
from sfmapp.geometry import rigid3
from sfmapp.images.bag_sequence import decode_raw
from sfmapp.images.headers import UnusableImage
from sfmapp.odometry.snapshot import FrameSnapshot

# While so many wait, what comes is dropped: a late pose is of no use to a robot.
FRAMES_WAITING = 4


class OdometryNode(Node):
    """Images that wait to be tracked, and the poses that come of them."""

    def __init__(self) -> None:
        super().__init__("sfmapp_odometry")
        self.camera: sfmapp.Camera | None = None
        self.has_camera = threading.Event()
        self.waiting: queue.Queue[Image | None] = queue.Queue(FRAMES_WAITING)
        self.num_dropped, self.white, self.time_s = 0, 255, 0.0
        self.publisher = self.create_publisher(PoseStamped, "pose", 10)
        self.create_subscription(CameraInfo, "camera_info", self.on_info, qos_profile_sensor_data)
        self.create_subscription(Image, "image", self.on_image, qos_profile_sensor_data)

    def on_info(self, info: CameraInfo) -> None:
        if self.camera is None and info.p[0] > 0:
            # the centre of the first pixel is at 0 in ROS, at a half in sfmapp
            params = np.array([info.p[0], info.p[5], info.p[2] + 0.5, info.p[6] + 0.5])
            self.camera = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, info.width, info.height, params)
            self.has_camera.set()

    def on_image(self, image: Image) -> None:
        try:
            self.waiting.put_nowait(image)
        except queue.Full:
            self.num_dropped += 1

    def frames(self) -> Iterator[np.ndarray]:
        while (image := self.waiting.get()) is not None:
            stamp = Stamp(Time.from_msg(image.header.stamp).nanoseconds, image.header.frame_id)
            data, is_big_endian = memoryview(image.data), bool(image.is_bigendian)
            raw = RawImage(stamp, image.height, image.width, image.encoding, is_big_endian, image.step, data)
            try:
                gray, self.white = decode_raw(raw, self.white)
            except UnusableImage as reason:
                self.get_logger().warning(f"an image is left out: {reason}")
                continue
            if stamp.ns / 1e9 > self.time_s:
                self.time_s = stamp.ns / 1e9
                yield gray

    def times(self) -> Iterator[float]:
        while True:  # one is asked for when its frame has come
            yield self.time_s

    def publish(self, frame: FrameSnapshot) -> None:
        if not np.isfinite(frame.cam_from_world).all():
            return
        pose = rigid3.inverse(frame.cam_from_world).tolist()
        message = PoseStamped()
        message.header.frame_id = f"map{frame.map_idx}"
        message.header.stamp = Time(nanoseconds=round(frame.timestamp_s * 1e9)).to_msg()
        for name, value in zip("xyzw", pose[:4], strict=True):
            setattr(message.pose.orientation, name, value)
        for name, value in zip("xyz", pose[4:], strict=True):
            setattr(message.pose.position, name, value)
        self.publisher.publish(message)

    def listen(self) -> None:
        try:
            rclpy.spin(self)
        except ExternalShutdownException:
            pass
        finally:
            self.has_camera.set()
            self.waiting.put(None)


def main() -> None:
    # a Ctrl-C ends the frames, and not what is made of them
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGINT, lambda *_: rclpy.shutdown())
    node = OdometryNode()
    threading.Thread(target=node.listen, daemon=True).start()
    node.has_camera.wait()
    if node.camera is None:
        sys.exit("no camera_info came")
    frames = sfmapp.ArraySequence(node.frames(), node.camera, timestamps_s=node.times())
    result = sfmapp.track_sequence(frames, "track", record=False, on_frame=node.publish)
    tracked = np.isfinite(result.odometry.cam_from_world[:, 0])
    print(f"{tracked.sum()} of {len(tracked)} frames have a pose, {node.num_dropped} were dropped")


if __name__ == "__main__":
    main()
