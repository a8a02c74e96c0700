"""Two views by hand: matches of OpenCV's verified, the relative pose, and triangulated points.

python examples/09_two_views.py left.jpg right.jpg 1000      # and the focal length in pixels
"""

import sys

import cv2
import numpy as np

import sfmapp


def main(left: str, right: str, focal_px: str) -> None:
    pictures = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in (left, right)]
    (keypoints1, bits1), (keypoints2, bits2) = (cv2.ORB_create(4000).detectAndCompute(p, None) for p in pictures)
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(bits1, bits2)
    xy1 = np.array([keypoints1[m.queryIdx].pt for m in found]) + 0.5  # the centre of the top-left pixel is (0.5, 0.5)
    xy2 = np.array([keypoints2[m.trainIdx].pt for m in found]) + 0.5

    height, width = pictures[0].shape
    params = [float(focal_px), width / 2, height / 2]
    camera = sfmapp.Camera(sfmapp.CameraModel.SIMPLE_PINHOLE, width, height, params, focal_source="user")
    pair = sfmapp.verify_pair(xy1, xy2, camera)
    print(f"{pair.config.name}: {pair.is_inlier.sum()} of {len(xy1)} matches, {pair.median_angle_deg:.1f} deg apart")

    poses = [sfmapp.Rigid3.identity(), sfmapp.Rigid3(pair.cam2_from_cam1)]
    points = sfmapp.triangulate(poses, camera, [xy1[pair.is_inlier], xy2[pair.is_inlier]])
    depths = points.xyz[points.is_inlier.all(axis=0), 2]
    print(f"{len(depths)} points, {np.median(depths):.1f} baselines away (median)")


if __name__ == "__main__":
    main(*sys.argv[1:])
