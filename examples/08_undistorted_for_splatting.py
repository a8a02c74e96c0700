"""Photographs to what trainers of Gaussian splats read: undistorted pictures and a PINHOLE model beside them.

python examples/08_undistorted_for_splatting.py photos/ out/ splat/
"""

import sys

import sfmapp


def main(photos: str, output: str, splat: str) -> None:
    sfmapp.reconstruct(photos, output, record=False)
    result = sfmapp.undistort(output, splat, blank_pixels=0.0, max_size=1600)
    model = sfmapp.load(result.output)
    for camera in model.cameras:
        print(camera.model.name, f"{camera.width}x{camera.height}", camera.params)
    print(
        f"{len(model.images)} pictures in {splat}/images, {len(model.points)} points to begin with in {splat}/sparse/0"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
