"""A carved volume joined with the patches of a dense run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfmapp.carve.hull import Hull
from sfmapp.carve.joined import Evidence, Joined, JoinReport, join
from sfmapp.carve.octree import Octree
from sfmapp.carve.sight import sights_of_patches
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.dense.files import read_patches
from sfmapp.errors import InputError
from sfmapp.pipelines.dense.results import PATCHES
from sfmapp.workspace.job import Job

STAGE = "join"


@dataclass(frozen=True)
class Photographs:
    """Cameras and silhouettes, one of each for a photograph, and their hull."""

    views: Sequence[View]
    silhouettes: Sequence[Silhouette]
    hull: Hull


def find_patches(source: str | os.PathLike[str], told: str | os.PathLike[str]) -> Path:
    """The file of patches that is meant: ``told``, or that of the workspace it is, or with nothing told of ``source``.

    Raises:
        InputError: there is none.
    """
    path = Path(told) if os.fspath(told) else Path(source)
    if path.is_dir():
        path = path / PATCHES
    if not path.is_file():
        raise InputError(
            f"--with-dense: expected patches in {path}, found nothing",
            "run sfmapp dense on the workspace first, or name it or its patches.npz",
        )
    return path


def join_patches(job: Job, path: Path, photographs: Photographs, octree: Octree) -> tuple[Joined, JoinReport]:
    """The volume that silhouettes and patches leave together, in the cube and the cells of the hull's octree.

    Raises:
        InputError: the file is no such file, its patches are of other photographs, or cameras are matrices.
        NoReconstructionError: patches are seen through all of the hull.
    """
    with job.stage(STAGE):
        sights = sights_of_patches(photographs.views, *read_patches(path))
        evidence = Evidence(photographs.views, photographs.silhouettes, photographs.hull, sights)
        return join(
            evidence, octree.low, octree.side, 2**octree.depth, events=job.events, threads=job.threads
        )  # fmt: skip
