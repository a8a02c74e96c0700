"""What finding silhouettes says of itself."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report


class PhotographMask(Report):
    """The silhouette in one photograph.

    Attributes:
        name: of the photograph.
        source: what told it: ``alpha``, ``mask``, ``background``, ``dark background``, ``grabcut``; ``none`` where
            nothing did.
        share: of the pixels that are inside.
        border_share: of the pixels along the edge of the picture that are inside.
        outline_sigma_px: standard deviation of the outline.
        is_usable: the mask is neither missing, empty, full nor inverted, whatever its camera.
        problem: what is wrong with it, empty if nothing is known to be; such a silhouette carves nothing.
        spilled, filled: share of the silhouette that was taken away, and filled, as the others speak against it.
        doubtful: share of holes that may be none, and were left.
        turned_deg: angle by which its camera seems to be turned; absent where it does not.
        turned_sigma_deg: standard deviation of that; absent where it is not known.
    """

    name: str
    source: str
    share: float
    border_share: float
    outline_sigma_px: float
    is_usable: bool
    problem: str
    spilled: float
    filled: float
    doubtful: float
    turned_deg: float | None = None
    turned_sigma_deg: float | None = None


class MasksReport(Report):
    """All of them.

    Attributes:
        masks: in the order of the photographs.
        color_error: share of pixels that colour alone would tell wrongly, by the overlap of the colours of object and
            background; None where colours were not asked.
        is_compared: with cameras, silhouettes are held against each other.
        warnings: lines for the user.
        wall_s: seconds that it took.
    """

    masks: Sequence[PhotographMask]
    color_error: float | None
    is_compared: bool
    warnings: Sequence[str]
    wall_s: float
