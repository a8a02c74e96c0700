"""What finding silhouettes says of itself."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report


class PhotographMask(Report):
    """The silhouette in one photograph.

    Attributes:
        name: of the photograph.
        source: what told it: ``alpha``, ``mask``, ``background``, ``grabcut``; ``none`` where nothing did.
        share: of the pixels that are inside.
        border_share: of the pixels along the edge of the picture that are inside.
        confidence: between 0.5 and 1, see :class:`sfmapp.carve.silhouettes.Silhouette`.
        outline_sigma_px: standard deviation of the outline.
        problem: what is wrong with it, empty if nothing is known to be; such a silhouette carves nothing.
    """

    name: str
    source: str
    share: float
    border_share: float
    confidence: float
    outline_sigma_px: float
    problem: str


class MasksReport(Report):
    """All of them.

    Attributes:
        masks: in the order of the photographs.
        color_error: share of pixels that colour alone would tell wrongly, by the overlap of the colours of object and
            background; None where colours were not asked.
        warnings: lines for the user.
        wall_s: seconds that it took.
    """

    masks: Sequence[PhotographMask]
    color_error: float | None
    warnings: Sequence[str]
    wall_s: float
