"""Live odometry on frames that a generator grabs: the pose of each as soon as it is known.

python examples/06_live_odometry.py walk.mp4 900        # a video, or frames/%06d.png, and the focal length in pixels
"""

import sys
from collections.abc import Iterator

import cv2
import numpy as np

import sfmapp


def grab(capture: cv2.VideoCapture) -> Iterator[np.ndarray]:
    while (read := capture.read())[0]:
        yield cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)


def main(video: str, focal_px: str) -> None:
    capture = cv2.VideoCapture(video)
    width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    focal = float(focal_px)
    camera = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, width, height, [focal, focal, width / 2, height / 2])
    frames = sfmapp.ArraySequence(grab(capture), camera, fps=30)
    # NaN as long as there is no map
    odometry, _ = sfmapp.track_sequence(frames, on_frame=lambda frame: print(frame.name, frame.cam_from_world.round(3)))
    tracked = np.isfinite(odometry.cam_from_world[:, 0])
    keyframes = odometry.maps[0].reconstruction
    print(f"{tracked.sum()} of {len(tracked)} frames have a pose, {len(keyframes.images)} are keyframes")


if __name__ == "__main__":
    main(*sys.argv[1:])
