"""A known distance between two photographs makes a reconstruction metric, and its sigmas with it.

python examples/11_factor_graph.py out/ 0.35 0.002
"""

import sys

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

import sfmapp


def main(workspace: str, distance: str, sigma: str) -> None:
    model = sfmapp.load(workspace)
    first, last = model.images[0], model.images[-1]
    # near the answer first: adjustments find the nearest minimum
    scale = float(distance) / np.linalg.norm(last.cam_from_world.center - first.cam_from_world.center)
    model.cam_from_world[:, 4:] *= scale
    model.point_xyz *= scale

    graph = sfmapp.FactorGraph(model)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, float(sigma))
    graph.add(gtsam.RangeFactorPose3(X(first.idx), X(last.idx), float(distance), noise))
    report = graph.optimize()
    for factors in report.factors:
        print(f"{factors.num_factors} {factors.kind}: normalised residual {factors.normalized_residual:.2f}")
    found = graph.marginal_covariance(images=[last.idx]).of_center(last.idx)
    print(f"{last.name} is {np.sqrt(np.trace(found)):.2g} m sure of its place among the others")
    model.save(f"{workspace}/metric/0")


if __name__ == "__main__":
    main(*sys.argv[1:])
