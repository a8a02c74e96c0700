"""What meshing and texturing have brought."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report, Step, Usage


class TextureReport(Report):
    """The texture of a mesh.

    Attributes:
        scale: texels for a pixel of the photographs, a side.
        width, height: texels.
        seen: share of the area that a photograph shows.
        seam_before, seam_after: root mean square difference of the colours at seams, of 255; after levelling.
    """

    num_charts: int
    scale: float
    width: int
    height: int
    seen: float
    seam_before: float
    seam_after: float
    wall_s: float


class MeshReport(Report):
    """A mesh.

    Attributes:
        depth: of the octree.
        spacing: of the patches, world units.
        num_rim_edges: 0 for a closed mesh.
        funnel: triangles left after each step.
        poisson: what Poisson took of it.
        texture: absent without.
    """

    depth: int
    spacing: float
    num_vertices: int
    num_faces: int
    num_rim_edges: int
    funnel: Sequence[Step]
    poisson: Usage
    wall_s: float
    cpu_s: float
    texture: TextureReport | None = None
