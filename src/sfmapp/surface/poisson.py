"""From oriented points to a closed surface: screened Poisson (Kazhdan and Hoppe, TOG 2013) as open3d has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.evaluation.measured import ProcessUsage
from sfmapp.events import Events
from sfmapp.packages import require
from sfmapp.surface.child import run_child
from sfmapp.surface.trim import pieces, rim

# open3d's Poisson has crashed with more than one
THREADS = 1
FEWEST_POINTS = 50
SHALLOWEST, DEEPEST = 6, 12
# the octree's box is so much larger than the points'
BOX_SCALE = 1.1
ADVICE = "try a smaller surface.depth or fewer patches (a coarser dense.level)"


@dataclass(frozen=True)
class ClosedSurface:
    """What Poisson makes, hallucinated parts and all, without any rim.

    Attributes:
        xyz: (N, 3) float64, world.
        faces: (F, 3) int32.
        density: (N,) float32, grows with the number of points around a vertex.
        usage: of the child process.
    """

    xyz: NDArray[np.float64]
    faces: NDArray[np.int32]
    density: NDArray[np.float32]
    usage: ProcessUsage


def depth_for(xyz: NDArray[np.float64], spacing: float) -> int:
    """The octree's depth at which its cells measure two spacings or less, 6 to 12.

    Finer cells would only model noise: a surface is sampled by points of some spacing up to a wavelength of two.
    """
    side = BOX_SCALE * float(np.ptp(xyz, axis=0).max())
    return int(np.clip(np.ceil(np.log2(max(side / (2.0 * spacing), 1.0))), SHALLOWEST, DEEPEST))


def poisson(
    xyz: NDArray[np.float64],
    normal: NDArray[np.float32],
    depth: int,
    events: Events | None = None,
    *,
    stage: str | None = None,
) -> ClosedSurface:
    """Reconstruct the surface in a child process.

    Args:
        xyz: (N, 3) points, world. They are centred and scaled on the way: open3d works on them in single precision.
        normal: (N, 3) outward; their lengths do not matter.
        depth: of the octree.
        events: cancellation; the child is killed.
        stage: which is told every two seconds how long it takes; None: nobody is told.

    Raises:
        NoReconstructionError: fewer than 50 points, or the child ended without a surface (the message says how).
        InterruptedRunError: ``events`` was asked to stop.
        MissingPackageError: open3d is not installed.
    """
    require("open3d", "libusb_package")
    if len(xyz) < FEWEST_POINTS:
        raise NoReconstructionError(
            f"Poisson reconstruction: expected at least {FEWEST_POINTS} oriented points, found {len(xyz)}"
        )
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    center, scale = (low + high) / 2.0, float((high - low).max())
    if not (np.isfinite(scale) and scale > 0.0):
        raise NoReconstructionError("Poisson reconstruction: expected finite points that are not all the same")
    arrays = {"xyz": ((xyz - center) / scale).astype(np.float32), "normal": np.asarray(normal, np.float32)}
    module = "sfmapp.surface.poisson_child"
    found, usage = run_child(
        module, "Poisson reconstruction", arrays, (depth, BOX_SCALE, THREADS), ADVICE, events or Events(),
        stage=stage,
    )  # fmt: skip
    if len(found["faces"]) == 0:
        raise NoReconstructionError("Poisson reconstruction: found no surface", ADVICE)
    xyz, faces = _with_lids(found["xyz"] * scale + center, found["faces"])
    density = np.pad(found["density"], (0, len(xyz) - len(found["xyz"])))
    return ClosedSurface(xyz, faces, density, usage)


def _with_lids(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The surface closed where it leaves the octree's box: each loop of its rim gets a fan about its centre."""
    edges = rim(faces)
    if not len(edges):
        return xyz, faces
    loop = pieces(edges, len(xyz))
    counts = np.bincount(loop)
    centers = np.stack([np.bincount(loop, xyz[edges[:, 0], axis]) / counts for axis in range(3)], axis=1)
    fans = np.column_stack([edges[:, ::-1], len(xyz) + loop])
    return np.concatenate([xyz, centers]), np.concatenate([faces, fans]).astype(np.int32)
