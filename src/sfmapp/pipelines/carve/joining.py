"""A carved volume joined with the patches of a dense run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sfmapp.carve.box import Box, clip_octree
from sfmapp.carve.files import read_joined, write_joined
from sfmapp.carve.hull import Hull
from sfmapp.carve.joined import Evidence, Joined, JoinOptions, JoinReport, join
from sfmapp.carve.octree import Octree
from sfmapp.carve.sight import sights_of_patches
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.dense.files import read_patches
from sfmapp.errors import InputError
from sfmapp.pipelines.carve.outputs import JOINED, JOINING, earlier
from sfmapp.pipelines.dense.results import PATCHES, file_digest
from sfmapp.reporting import from_plain
from sfmapp.workspace.job import Job
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.layout import CARVE

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


@dataclass(frozen=True)
class Joining:
    """A joined volume, and what it was joined of.

    Attributes:
        evidence: silhouettes and patches. hull_octree: the hull's cells.
    """

    joined: Joined
    report: JoinReport
    evidence: Evidence
    hull_octree: Octree


def join_in_box(
    job: Job, evidence: Evidence, octree: Octree, box: Box, options: JoinOptions | None = None
) -> tuple[Joined, JoinReport]:
    """The volume that silhouettes and sights leave together, in the cube and the cells of the hull's octree, what is in
    the box if that is a user's.

    Raises:
        NoReconstructionError: all of the hull is seen through.
    """
    joined, report = join(
        evidence, octree.low, octree.side, 2**octree.depth, options, events=job.events, threads=job.threads
    )  # fmt: skip
    if box.told_by == "user":
        joined = replace(joined, tree=clip_octree(joined.tree, box))
    return joined, report


def join_patches(job: Job, path: Path, photographs: Photographs, octree: Octree, box: Box) -> Joining:
    """The volume that silhouettes and patches leave together, in the cube and the cells of the hull's octree, what is
    in the box if that is a user's; that of an earlier call where it was joined of the same.

    Raises:
        InputError: the file is no such file, its patches are of other photographs, or cameras are matrices.
        NoReconstructionError: patches are seen through all of the hull.
    """
    with job.measured("sights"):
        sights = sights_of_patches(photographs.views, *read_patches(path))
    evidence = Evidence(photographs.views, photographs.silhouettes, photographs.hull, sights)
    folder = job.workspace.folder
    # the octree's own key tells the photographs, their cameras and silhouettes
    key = stage_key((__name__,), None, job.workspace.manifest.stage(CARVE).key, file_digest(path))

    def read() -> tuple[Joined, JoinReport]:
        return read_joined(folder / JOINED), from_plain(JoinReport, job.workspace.read_json(JOINING))

    found = earlier(job, STAGE, key, read, "patches were joined by an earlier call")
    if found is not None:
        return Joining(*found, evidence, octree)
    with job.stage(STAGE, key):
        joined, report = join_in_box(job, evidence, octree, box)
        write_joined(folder / JOINED, joined)
        job.workspace.write_json(JOINING, report)
    job.workspace.save()  # a call that is stopped from here on need not join again
    return Joining(joined, report, evidence, octree)
