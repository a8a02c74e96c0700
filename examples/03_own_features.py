"""Features and matches of your own, from a network or from OpenCV: float descriptors, bits, or matches alone.

python examples/03_own_features.py photos/
"""

import sys

import cv2
import numpy as np

import sfmapp


class CrossCheckMatcher:
    """Anything with this one method can stand here: LightGlue, SuperGlue, ..."""

    def match(self, first: sfmapp.Features, second: sfmapp.Features) -> np.ndarray:
        found = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(first.descriptors, second.descriptors)
        return np.array([(m.queryIdx, m.trainIdx) for m in found]).reshape(-1, 2)


def main(photos: str) -> None:
    images = sfmapp.load_images(photos)
    detector, features = cv2.SIFT_create(2000), []
    for record in images.images:
        keypoints, descriptors = detector.detectAndCompute(cv2.imread(str(record.path), cv2.IMREAD_GRAYSCALE), None)
        # OpenCV and most networks call the centre of the top-left pixel (0, 0); here it is (0.5, 0.5)
        xy = np.array([k.pt for k in keypoints]) + 0.5
        features.append(sfmapp.Features.from_arrays(xy, descriptors, metric="l2"))

    correspondences = sfmapp.match_images(images, features, matcher=CrossCheckMatcher())
    model = sfmapp.map_images(images, features, correspondences)[0]
    print(f"{len(model.registered_idx)} of {len(images.names)} images, {len(model.points)} points")


if __name__ == "__main__":
    main(*sys.argv[1:])
