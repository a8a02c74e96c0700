"""Odometry as a node of ROS 2: poses of a camera as they are found; frames that come too fast are dropped and counted.

    source /opt/ros/humble/setup.bash
    python examples/ros2/odometry_node.py --ros-args -r image:=/camera/image_rect -r camera_info:=/camera/camera_info

Needs rclpy, which ROS 2 brings, in a Python that has sfmapp. Images have to be rectified: their camera is P of
camera_info. Poses of the camera in the world go to the topic pose, in an arbitrary unit. After Ctrl-C the map is
adjusted once more and written to track/.
"""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
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


class OdometryNode(Node):
    """Pushes images, and publishes the poses that come of them; both in threads of their own."""

    def __init__(self) -> None:
        super().__init__("sfmapp_odometry")
        self.odometry: sfmapp.LiveOdometry | None = None
        self.white = 255
        self.publisher = self.create_publisher(PoseStamped, "pose", 10)
        self.create_subscription(CameraInfo, "camera_info", self.on_info, qos_profile_sensor_data)
        self.create_subscription(Image, "image", self.on_image, qos_profile_sensor_data)

    def on_info(self, info: CameraInfo) -> None:
        if self.odometry is None and info.p[0] > 0:
            # the centre of the first pixel is at 0 in ROS, at a half in sfmapp
            params = np.array([info.p[0], info.p[5], info.p[2] + 0.5, info.p[6] + 0.5])
            camera = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, info.width, info.height, params)
            self.odometry = sfmapp.LiveOdometry(camera, "track", on_pose=self.publish, record=False)

    def on_image(self, image: Image) -> None:
        if self.odometry is None:
            return
        stamp = Stamp(Time.from_msg(image.header.stamp).nanoseconds, image.header.frame_id)
        data, is_big_endian = memoryview(image.data), bool(image.is_bigendian)
        raw = RawImage(stamp, image.height, image.width, image.encoding, is_big_endian, image.step, data)
        try:
            gray, self.white = decode_raw(raw, self.white)
            self.odometry.push(gray, stamp.ns / 1e9)
        except (UnusableImage, sfmapp.InputError) as reason:
            self.get_logger().warning(f"an image is left out: {reason}")

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


def main() -> None:
    # a Ctrl-C ends the frames, and not what is made of them
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    node = OdometryNode()
    try:
        while True:
            rclpy.spin_once(node, timeout_sec=0.5)
    except KeyboardInterrupt:
        pass
    if node.odometry is None:
        sys.exit("no camera_info came")
    tracked = np.isfinite(node.odometry.close().odometry.cam_from_world[:, 0])
    print(f"{tracked.sum()} of {len(tracked)} frames have a pose, {node.odometry.report.num_dropped} were dropped")
    rclpy.shutdown()


if __name__ == "__main__":
    main()
