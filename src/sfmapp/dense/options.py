"""Options of densification."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.errors import UsageError


@dataclass(frozen=True)
class DenseOptions:
    """What ``sfmapp dense`` obeys.

    Attributes:
        level: how often the images are halved before they are matched; 0 is full resolution, None lets the longer side
            come out at 1600 pixels or fewer.
        ground_sampling: resolution by target: what a pixel should measure on the surface, in units of the world;
            each image is shrunk to it. None: ``level`` decides.
        cell_px: a patch for each cell of so many pixels a side; 1 is densest.
        min_views: images that have to trust a patch, its reference image among them. One fewer will do, down to two,
            where none of the others can see it: outside of their pictures, turned away, or hidden by other patches.
        max_neighbors: images that each image is matched with.
        region: x y z of the lower and x y z of the upper corner of the box to reconstruct, world; None: no bounds.
        max_memory_mb: views are worked on in clusters that are expected to stay below this.
    """

    level: int | None = None
    ground_sampling: float | None = None
    cell_px: int = 1
    min_views: int = 3
    max_neighbors: int = 8
    region: tuple[float, ...] | None = None
    max_memory_mb: int = 3000

    def __post_init__(self) -> None:
        if self.level is not None and not 0 <= self.level <= 6:
            raise UsageError(f"dense.level: expected 0 to 6, got {self.level}")
        if self.ground_sampling is not None and not 0.0 < self.ground_sampling < float("inf"):
            raise UsageError(f"dense.ground_sampling: expected a positive length, got {self.ground_sampling:g}")
        if self.level is not None and self.ground_sampling is not None:
            raise UsageError("dense.level and dense.ground_sampling both set the resolution", "leave one of them out")
        if not 1 <= self.cell_px <= 8:
            raise UsageError(f"dense.cell_px: expected 1 to 8, got {self.cell_px}")
        if not 2 <= self.min_views <= 8:
            raise UsageError(f"dense.min_views: expected 2 to 8, got {self.min_views}")
        if not 2 <= self.max_neighbors <= 16:
            raise UsageError(f"dense.max_neighbors: expected 2 to 16, got {self.max_neighbors}")
        if self.max_memory_mb < 500:
            raise UsageError(f"dense.max_memory_mb: expected 500 or more, got {self.max_memory_mb}")
        if self.region is not None:
            corners = tuple(float(value) for value in self.region)
            object.__setattr__(self, "region", corners)
            if len(corners) != 6 or not all(low < high for low, high in zip(corners[:3], corners[3:], strict=True)):
                raise UsageError(
                    f"dense.region: expected x y z of the lower, then of the upper corner, got {self.region}"
                )
