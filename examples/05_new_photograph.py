"""Where was one more photograph taken? Its pose (PnP) and the covariance of it, in a reconstruction of the others.

python examples/05_new_photograph.py photos/ new.jpg         # which lies in photos/
"""

import sys

import numpy as np

import sfmapp


def main(photos: str, new: str) -> None:
    images = sfmapp.load_images(photos)
    features = sfmapp.extract_features(images)
    query = images.names.index(new)
    others = [i for i in range(len(images.names)) if i != query]
    correspondences = sfmapp.match_images(images, features, [(i, j) for i in others for j in others if i < j])
    model = sfmapp.map_images(images, features, correspondences)[0]

    place_of_keypoint = {}  # of the new photograph
    found = sfmapp.match_images(images, features, [(i, query) for i in others])
    for p, (i, j) in enumerate(found.pair_image_idx):
        column = 1 if j == query else 0
        seen = model.image(int(i if j == query else j)).observations
        track_of = dict(zip(seen.feature_idx[seen.is_inlier], seen.track_ids[seen.is_inlier], strict=True))
        for match in found.matches_of_pair(p):
            if match[1 - column] in track_of:
                place_of_keypoint[match[column]] = model.point_xyz[track_of[match[1 - column]]]

    xy = features[query].keypoints[list(place_of_keypoint), :2]
    pose = sfmapp.estimate_pose(list(place_of_keypoint.values()), xy, model.camera(0))
    print(f"{pose.is_inlier.sum()} of {len(xy)} points agree: taken from {pose.cam_from_world.center}")
    print(f"sigmas of rotation (rad) and translation: {np.sqrt(np.diag(pose.covariance))}")


if __name__ == "__main__":
    main(*sys.argv[1:])
