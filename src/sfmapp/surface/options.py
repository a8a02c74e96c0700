"""Options of meshing."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import Range, check_options

_RANGES = {
    "depth": Range(4, 13),
    "trim_distance": Range(0.5, 1000.0),  # patch spacings
    "trim_density": Range(0.0, 0.99),
    "max_hole": Range(0.0, 0.99),
    "min_island": Range(0.0, 0.99),
    "texture_px": Range(256, 16384),
}


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of ``sfmapp mesh``.

    Attributes:
        depth: the finest cells are 2^depth a side of the scene's box; None: cells of about two patch spacings. Where
            patches are sparser, cells are larger whatever is said here.
        trim_distance: surface farther than this from every patch is cut off, in units of the local patch spacing.
            At 3, of the distances and density quantiles tried on a rendered scene, accuracy and completeness were both
            best.
        trim_density: share of the vertices, those with the fewest patches around them, that is cut off first; 0: none.
        max_hole: holes left by trimming are closed again if their share of the surface's area is no more than this,
            or a quarter of this where views show them, and no larger one is left: all-round captures stay closed where
            nothing was matched. A surface that stays open elsewhere has just its small holes closed, up to 20 spacings
            of the patches wide: what lies behind larger ones is a guess. 0: none. At 0.2 there is room on both sides:
            the unseen base of a small temple is 0.15, what would close the outline of a wall about 1.
        min_island: connected pieces with less than this share of the surface's area are dropped.
        texture: give ``mesh.glb`` the photographs as a texture (:func:`~sfmapp.surface.texture.texture_mesh`).
        texture_px: longest side of the texture; it is smaller where the photographs have less to show.
    """

    depth: int | None = None
    trim_distance: float = 3.0
    trim_density: float = 0.0
    max_hole: float = 0.2
    min_island: float = 0.005
    texture: bool = False
    texture_px: int = 4096

    def __post_init__(self) -> None:
        check_options("surface", self, _RANGES)
