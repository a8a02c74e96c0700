"""How sure is a point, and how sure a camera? Marginal covariances of a reconstruction.

python examples/07_covariance.py out/
"""

import sys

import numpy as np

import sfmapp


def main(workspace: str) -> None:
    model = sfmapp.load(workspace)
    sfmapp.adjust_bundle(model)  # covariances are those of a minimum
    covariances = model.covariance()
    print(f"one coordinate of an observation is {covariances.sigma_px:.2f} px off (standard deviation)")

    points = model.points
    sigma = np.array([np.sqrt(np.trace(covariances.of_point(track))) for track in points.ids])
    for k in np.argsort(sigma)[[0, len(sigma) // 2, -1]]:
        print(f"point {points.ids[k]} at {points.xyz[k]}: +- {sigma[k]:.2g}, seen by {points.num_images[k]} images")
    image = model.images[0]
    rotation, translation = np.split(np.sqrt(np.diag(covariances.of_image(image.idx))), 2)
    print(f"{image.name}: rotation +- {np.degrees(rotation)} deg, translation +- {translation}")


if __name__ == "__main__":
    main(*sys.argv[1:])
