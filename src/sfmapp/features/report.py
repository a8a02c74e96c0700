"""What extraction has brought."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report

# fewer keypoints than this leave too few matches for any pair, whatever the other image holds
FEW_FEATURES = 100


class ImageFeatures(Report):
    """The keypoints of one image.

    Attributes:
        warnings: for a person; they name the image.
        known: True where they are of an earlier run; absent elsewhere.
        scale: factor that the image was scaled by before detection.
        contrast_threshold: in use; None for ORB.
        cpu_s: of the thread that worked on it.
    """

    name: str
    num_features: int
    warnings: Sequence[str]
    known: bool | None = None
    scale: float | None = None
    contrast_threshold: float | None = None
    cpu_s: float | None = None


class FeaturesReport(Report):
    """What the stage ``features`` found; ``num_known``: images whose features are of an earlier run."""

    kind: str
    num_images: int
    num_known: int
    num_features: int
    images: Sequence[ImageFeatures]
    warnings: Sequence[str]
    wall_s: float
    cpu_s: float
