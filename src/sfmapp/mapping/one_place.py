"""What is the case where photographs show no depth: one picture many times, a burst, or turning on the spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, bearings
from sfmapp.geometry import homography, rigid3
from sfmapp.mapping.focal import matched_pixels
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.tracks import Tracks

# Rotations explain this share of all verified matches, or something else is the case as well.
_ROTATION_SHARE = 0.9
# Pairs looked at, those with most matches first.
_MOST_PAIRS = 200
# The same picture, recompressed or with other noise, moves by less than that: pixels, median of the matches.
_SAME_PICTURE_PX = 0.5
# A camera that is held still is turned by less than that from one photograph to another.
_HELD_STILL_DEG = 3.0
_MOVE = "take photographs that overlap by more than half while moving sideways between them"


@dataclass(frozen=True)
class OnePlace:
    """Photographs whose verified pairs are mere rotations.

    Attributes:
        num_images: photographs in such pairs. num_places: groups of them that no pair joins.
        shift_px: largest of the medians by which the picture moves in a pair.
        turn_deg: largest rotation of a pair.
    """

    num_images: int
    num_places: int
    shift_px: float
    turn_deg: float

    def describe(self) -> tuple[str, str]:
        """What is the case, and what to do about it."""
        many = f"{self.num_images} photographs"
        if self.shift_px < _SAME_PICTURE_PX and self.num_places == 1:
            text = f"{many} show the same picture: it moves by {self.shift_px:.1f} px at most from one to another"
            return text, f"copies of one picture hold no depth: {_MOVE}"
        if self.num_places > 1:
            text = (
                f"{many} are of {self.num_places} places, none of which has verified matches with another; those of "
                f"one place differ by rotations of up to {self.turn_deg:.1f} degrees alone"
            )
            return text, f"photographs of one place hold no depth: {_MOVE}, also from one place to the next"
        if self.turn_deg < _HELD_STILL_DEG:
            text = (
                f"{many} are a burst from one place, or from places too near to each other for how far away everything "
                f"is: they differ by rotations of up to {self.turn_deg:.1f} degrees alone"
            )
            return text, f"a burst holds no depth: {_MOVE}"
        text = f"{many} were taken turning on the spot, by up to {self.turn_deg:.0f} degrees from one to another"
        advice = f"turning on the spot gives no depth: {_MOVE}; or have sfmapp panorama make one picture of them"
        return text, advice


def find_one_place(
    correspondences: Correspondences, tracks: Tracks, cameras: Sequence[Camera], image_camera_idx: NDArray[np.int32]
) -> OnePlace | None:
    """What the pairs tell together where nearly all of them are rotations; None where they are not."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    counts = correspondences.num_inliers
    is_rotation = np.isin(correspondences.config, (TwoViewConfig.PANORAMIC, TwoViewConfig.PLANAR_OR_PANORAMIC))
    pairs = np.flatnonzero(is_rotation & (counts > 0))
    if not len(pairs) or counts[pairs].sum() < _ROTATION_SHARE * counts.sum():
        return None
    i, j = correspondences.pair_image_idx[pairs].T
    num = len(image_camera_idx)
    _, place = connected_components(coo_array((np.ones(len(pairs)), (i, j)), shape=(num, num)), directed=False)
    members = np.unique(np.concatenate([i, j]))
    shifts, turns = [], []
    for pair in pairs[np.argsort(-counts[pairs], kind="stable")][:_MOST_PAIRS]:
        both = [cameras[image_camera_idx[k]] for k in correspondences.pair_image_idx[pair]]
        xy1, xy2 = matched_pixels(tracks, correspondences, int(pair))
        if len(xy1) < 3:
            continue
        shifts.append(float(np.median(np.linalg.norm(xy2 - xy1, axis=1))))
        turns.append(_turn_deg(*bearings(both, (xy1, xy2))))
    if not shifts:
        return None
    return OnePlace(len(members), len(np.unique(place[members])), max(shifts), max(turns))


def _turn_deg(rays1: NDArray[np.float64], rays2: NDArray[np.float64]) -> float:
    known = np.isfinite(rays1[:, 0]) & np.isfinite(rays2[:, 0])
    rotation = homography.rotation_from_rays(rays1[known], rays2[known], np.ones(int(known.sum())))
    return float(np.degrees(np.linalg.norm(rigid3.log_so3(rotation))))
