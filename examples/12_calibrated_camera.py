"""A camera from photographs of a board, how sure it is where, and whether it is still the one of last year.

python examples/12_calibrated_camera.py board/ chessboard:9x6:0.025 cam/ [cam-last-year/]
"""

import sys

import numpy as np

import sfmapp
from sfmapp.calibration.uncertainty import projection_sigma


def main(photos: str, board: str, output: str, *earlier: str) -> None:
    made = sfmapp.calibrate_board(photos, output, board).calibration
    print(f"{made.method}: {made.camera.model.name}, residuals {made.rms_px:.3f} px")
    for name, value, sigma in zip(made.param_names, made.camera.params, made.sigmas, strict=True):
        print(f"{name:>4} {value:12.5f} +- {sigma:.5f}")
    size = np.array([made.camera.width, made.camera.height])
    for where, share in (("middle", 0.5), ("corner", 0.02)):
        sigma = projection_sigma(made, share * size[None])[0]
        print(f"a far point in the {where} is projected to {sigma:.3f} px")
    for folder in earlier:
        found = sfmapp.compare_cameras(output, folder)
        verdict = "the same camera" if found.is_same else "another camera, or one that has changed"
        print(f"{folder}: {verdict}, {np.nanmax(found.length):.2f} px apart at most")


if __name__ == "__main__":
    main(*sys.argv[1:])
