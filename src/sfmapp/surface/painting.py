"""From photographs to texels."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

# texels so far outside a triangle are painted too: no cracks between neighbours, whatever the rounding
BLEED_TEXELS = 0.75


@numba.njit(cache=True, nogil=True)
def paint(
    face_idx: NDArray[np.int64],
    faces: NDArray[np.int32],
    places: NDArray[np.float64],
    pixels: NDArray[np.float64],
    offset: NDArray[np.float32],
    image: NDArray[np.uint8],
    texture: NDArray[np.uint8],
    painted: NDArray[np.uint8],
) -> None:
    """Paint triangles from a photograph, bilinearly sampled, plus an offset of the colour.

    Args:
        face_idx: (K,) which of the faces (F, 3).
        places: (N, 2) vertices in the texture, in texels.
        pixels: (N, 2) vertices in the photograph, in pixels.
        offset: (N, 3) added to the colours.
        image: (H, W, 3).
        texture: (T, S, 3), painted in place.
        painted: (T, S), set to 1 where it was.
    """
    height, width = texture.shape[:2]
    for n in range(len(face_idx)):
        i, j, k = faces[face_idx[n], 0], faces[face_idx[n], 1], faces[face_idx[n], 2]
        ax, ay, bx, by, cx, cy = places[i, 0], places[i, 1], places[j, 0], places[j, 1], places[k, 0], places[k, 1]
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(twice) < 1e-9:
            continue
        # a weight changes by this much from the side to a place a texel outside it
        slack_a = BLEED_TEXELS * np.hypot(cx - bx, cy - by) / abs(twice)
        slack_b = BLEED_TEXELS * np.hypot(ax - cx, ay - cy) / abs(twice)
        slack_c = BLEED_TEXELS * np.hypot(bx - ax, by - ay) / abs(twice)
        top, bottom = max(0, int(min(ay, by, cy) - 1.0)), min(height - 1, int(max(ay, by, cy) + 1.0))
        left, right = max(0, int(min(ax, bx, cx) - 1.0)), min(width - 1, int(max(ax, bx, cx) + 1.0))
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                x, y = col + 0.5, row + 0.5
                wb = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / twice
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / twice
                wa = 1.0 - wb - wc
                if wa < -slack_a or wb < -slack_b or wc < -slack_c:
                    continue
                is_inside = wa >= 0.0 and wb >= 0.0 and wc >= 0.0
                if painted[row, col] and not is_inside:
                    continue  # what is inside a triangle goes before what another one bleeds
                u = wa * pixels[i, 0] + wb * pixels[j, 0] + wc * pixels[k, 0]
                v = wa * pixels[i, 1] + wb * pixels[j, 1] + wc * pixels[k, 1]
                u = min(max(u - 0.5, 0.0), image.shape[1] - 1.0)
                v = min(max(v - 0.5, 0.0), image.shape[0] - 1.0)
                c0, r0 = int(u), int(v)
                c1, r1 = min(c0 + 1, image.shape[1] - 1), min(r0 + 1, image.shape[0] - 1)
                fu, fv = u - c0, v - r0
                for channel in range(3):
                    above = (1.0 - fu) * image[r0, c0, channel] + fu * image[r0, c1, channel]
                    below = (1.0 - fu) * image[r1, c0, channel] + fu * image[r1, c1, channel]
                    value = (1.0 - fv) * above + fv * below
                    value += wa * offset[i, channel] + wb * offset[j, channel] + wc * offset[k, channel]
                    texture[row, col, channel] = np.uint8(min(max(value + 0.5, 0.0), 255.0))
                painted[row, col] = 1


def fill_gaps(texture: NDArray[np.uint8], painted: NDArray[np.uint8]) -> None:
    """Give every texel (in place) that was not painted the colour of the nearest one that was.

    Viewers that shrink or filter the texture then find no foreign colour beside a chart.
    """
    import cv2

    if not painted.any():
        return
    _, label = cv2.distanceTransformWithLabels(
        1 - painted, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    is_painted = painted.astype(np.bool_)
    color = np.zeros((int(label.max()) + 1, 3), np.uint8)
    color[label[is_painted]] = texture[is_painted]
    texture[~is_painted] = color[label[~is_painted]]
