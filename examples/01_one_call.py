"""Photographs to cameras and points, in one call.

python examples/01_one_call.py photos/ out/
"""

import sys

import sfmapp


def main(photos: str, output: str) -> None:
    reconstruction, _ = sfmapp.reconstruct(photos, output)
    for image in reconstruction.images:
        print(image.name, image.cam_from_world.center, f"{len(image.track_ids)} points")
    points = reconstruction.points
    print(f"{len(points)} points, seen by {points.num_images.mean():.1f} images, {points.error_px.mean():.2f} px off")
    print(f"how good it is, and why: {output}/report.html")


if __name__ == "__main__":
    main(*sys.argv[1:])
