"""Options of densification."""

from __future__ import annotations

from dataclasses import dataclass, field

from sfmapp.errors import UsageError
from sfmapp.option_checks import RESOURCE, Range, check_options, positive

# two images that agree by chance are outvoted by a third
USUAL_VIEWS, FEWEST_VIEWS = 3, 2
_RANGES = {
    "level": Range(0, 6),
    "ground_sampling": positive(),
    "cell_px": Range(1, 8),
    "min_views": Range(FEWEST_VIEWS, 8),
    "max_neighbors": Range(2, 16),
    "max_memory_mb": Range(500),
}


@dataclass(frozen=True)
class DenseOptions:
    """Options of ``sfmapp dense``.

    Attributes:
        level: how many times the images are halved before matching; 0: full resolution; None: until the longer side is
            1600 pixels or less.
        ground_sampling: size of a pixel on the surface, in units of the world, to which each image is shrunk. None:
            ``level`` decides.
        cell_px: side of a cell in pixels; each cell gets one patch, so 1 is densest.
        min_views: images that have to trust a patch, its reference image among them. One fewer will do, down to two,
            where none of the others can see it: outside of their pictures, turned away, or hidden by other patches.
            None: three, or two where there are no more.
        max_neighbors: most images that each image is matched with.
        region: x y z of the lower and x y z of the upper corner of the box to reconstruct, world; None: no bounds.
        max_memory_mb: the views are split into clusters that are expected to need less than this.
    """

    level: int | None = None
    ground_sampling: float | None = None
    cell_px: int = 1
    min_views: int | None = None
    max_neighbors: int = 8
    region: tuple[float, ...] | None = None
    max_memory_mb: int = field(default=3000, metadata=RESOURCE)

    def views_to_agree(self, num_views: int) -> int:
        """Of so many, how many have to trust a patch."""
        if self.min_views is not None:
            return self.min_views
        return FEWEST_VIEWS if num_views == FEWEST_VIEWS else USUAL_VIEWS

    def __post_init__(self) -> None:
        check_options("dense", self, _RANGES)
        if self.level is not None and self.ground_sampling is not None:
            raise UsageError("dense.level and dense.ground_sampling both set the resolution", "leave one of them out")
        if self.region is not None:
            corners = tuple(float(value) for value in self.region)
            object.__setattr__(self, "region", corners)
            if len(corners) != 6 or not all(low < high for low, high in zip(corners[:3], corners[3:], strict=True)):
                raise UsageError(
                    f"dense.region: expected x y z of the lower, then of the upper corner, got {self.region}"
                )
