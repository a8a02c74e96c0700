"""The stages one by one, on images in memory: nothing is read from files or written to them in between.

python examples/02_stages.py photos/ model/
"""

import sys
from pathlib import Path

import cv2

import sfmapp


def main(photos: str, model_folder: str) -> None:
    arrays = {path.name: cv2.imread(str(path))[..., ::-1] for path in sorted(Path(photos).iterdir())}  # RGB

    images = sfmapp.load_images(arrays, sfmapp.ImageOptions(camera_model="RADIAL"))
    features = sfmapp.extract_features(images, sfmapp.FeatureOptions(max_num_features=4096))
    correspondences = sfmapp.match_images(images, features, seed=1)
    for (i, j), count in zip(correspondences.pair_image_idx, correspondences.num_inliers, strict=True):
        print(f"{images.names[i]} and {images.names[j]}: {count} matches")
    models = sfmapp.map_images(images, features, correspondences)

    best = models[0]
    print(f"{len(best.registered_idx)} of {len(arrays)} images, camera {best.camera(0).params}")
    best.save(model_folder)  # COLMAP's binary format


if __name__ == "__main__":
    main(*sys.argv[1:])
