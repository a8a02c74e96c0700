"""Photographs in their cameras, as recordings of dense patches and of swept maps show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.viewer.stage import frustum_length

BLUE = (70, 150, 255)
# negative: in points of the screen, not in units of the scene
LINE_WIDTH = -1.0


def log_cameras(
    recording: rr.RecordingStream,
    names: Sequence[str],
    cam_from_world: NDArray[np.float64],
    k: NDArray[np.float64],
    size: NDArray[np.int64],
    pictures: Sequence[rr.EncodedImage],
    xyz: NDArray[np.float32],
) -> None:
    """Pose, frustum and picture of each camera, there from the beginning, as ``world/scene/cameras/NAME``.

    Args:
        names: N. cam_from_world: (N, 7). k: (N, 4) fx, fy, cx, cy and size: (N, 2) width and height, pixels.
        pictures: N. xyz: (M, 3) points of the scene, which say how long frusta are.
    """
    length = frustum_length(rigid3.center(cam_from_world), xyz.astype(np.float64))
    world_from_cam = rigid3.inverse(cam_from_world)
    for view, name in enumerate(names):
        path = rr.new_entity_path(["world", "scene", "cameras", name])
        pose = rr.Transform3D(
            translation=world_from_cam[view, 4:], quaternion=rr.Quaternion(xyzw=world_from_cam[view, :4].tolist())
        )
        recording.log(path, pose, static=True)
        # axes of no length are an error to the viewer
        recording.log(path, rr.TransformAxes3D(1e-6 * length), static=True)
        fx, fy, cx, cy = k[view]
        pinhole = rr.Pinhole(
            image_from_camera=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], resolution=size[view].tolist(),
            camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=length, line_width=LINE_WIDTH, color=BLUE,
        )  # fmt: skip
        recording.log(path, pinhole, static=True)
        recording.log(path, pictures[view], static=True)
