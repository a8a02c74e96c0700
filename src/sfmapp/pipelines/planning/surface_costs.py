"""What patches and a mesh will take after the reconstruction: roughly, as it hangs on how much photographs show of the
same, and on what of it has texture."""

from __future__ import annotations

from dataclasses import replace

from sfmapp.dense.prepare import working_shrink
from sfmapp.pipelines.planning.costs import Given, program_mb, wall_of
from sfmapp.report.plan import Interval, StagePlan

# Patches for each cell of the photographs at working size: 0.09 to 0.28 on five sets, of an object before a plain
# background the fewest, where all is near and textured the most.
_PATCHES_PER_CELL = Interval(0.07, 0.16, 0.3)
# A million patches take as many CPU seconds as features of so many megapixels do: 13 to 31 us a patch on eight sets; so
# do those of its surface, 11 to 17 us a patch of three scenes, on a machine where features of the bundled sample
# took 0.31 s a megapixel.
_DENSE_MEGAPIXELS, _MESH_MEGAPIXELS = Interval(80.0, 125.0, 190.0), Interval(34.0, 45.0, 58.0)
# bytes in memory for a patch: of patches, which clusters keep below a limit, and of their surface, where they are read
# again: 411 to 479 on three sets of 0.6 to 1.2 million
_DENSE_BYTES, _MESH_BYTES = 270.0, 430.0
# bytes on disk: of fused.ply and patches.npz, and beside them of mesh.ply and mesh.glb: 85 of that wall
_DENSE_FILE_BYTES, _MESH_FILE_BYTES = 130.0, 80.0
# shares of their CPU time that threads share
_DENSE_PARALLEL, _MESH_PARALLEL = 0.9, 0.6


def surface_costs(given: Given, *, mesh: bool) -> tuple[list[StagePlan], Interval]:
    """Stages of patches, and of a mesh if there is to be one, and MB of what they write."""
    options, machine = given.options.dense, given.machine
    # what a pixel on the surface is to measure says nothing before there is one
    by_level = replace(options, ground_sampling=None)
    cells = 0.0
    for image in given.images:
        side = working_shrink(by_level, image.width, image.height, 1.0, 1.0) * options.cell_px
        cells += image.width * image.height / side**2
    patches = _times(_PATCHES_PER_CELL, cells / 1e6)
    unit = machine.image_cpu_s / machine.megapixels
    cores = min(given.options.num_workers, machine.cores)
    rows = [("dense", _DENSE_MEGAPIXELS, _DENSE_PARALLEL, _DENSE_BYTES, float(options.max_memory_mb))]
    if mesh:
        rows.append(("mesh", _MESH_MEGAPIXELS, _MESH_PARALLEL, _MESH_BYTES, float("inf")))
    stages = []
    for name, megapixels, parallel, num_bytes, limit_mb in rows:
        cpu = Interval(*(unit * a * b for a, b in zip(_ends(megapixels), _ends(patches), strict=True)))
        memory = Interval(*(program_mb(machine) + min(num_bytes * number, limit_mb) for number in _ends(patches)))
        stages.append(StagePlan(stage=name, cpu_s=cpu, wall_s=wall_of(cpu, parallel, cores), memory_mb=memory))
    file_bytes = _DENSE_FILE_BYTES + (_MESH_FILE_BYTES if mesh else 0.0)
    return stages, _times(patches, file_bytes)


def _ends(interval: Interval) -> tuple[float, float, float]:
    return interval.low, interval.likely, interval.high


def _times(interval: Interval, factor: float) -> Interval:
    return Interval(*(factor * end for end in _ends(interval)))
