"""Packs charts into an atlas in a process of its own, ``python -m sfmapp.surface.pack_child``.

The files are npz (see :mod:`sfmapp.surface.texture`).
"""

from __future__ import annotations

import sys

SMALLEST_SCALE = 0.01


def main(source: str, target: str, side: str, padding: str) -> None:
    """From charts in texels to their places in one square of at most a side, made smaller where they do not fit."""
    import numpy as np
    import xatlas

    with np.load(source, allow_pickle=False) as data:
        uv, faces, chart, area = data["uv"], data["faces"], data["chart"], float(data["area"])
    # packing seldom does better than this
    scale = min(1.0, float(np.sqrt(0.8 * float(side) ** 2 / max(area, 1.0))))
    while True:
        atlas = xatlas.Atlas()
        atlas.add_uv_mesh(uv * np.float32(scale), faces, chart[:, None])
        packing = xatlas.PackOptions()
        packing.texels_per_unit = 1.0
        packing.padding = int(padding)
        packing.bilinear = True
        packing.rotate_charts = packing.rotate_charts_to_axis = False
        atlas.generate(xatlas.ChartOptions(), packing)
        longer = max(atlas.width, atlas.height)
        if longer <= int(side) or scale < SMALLEST_SCALE:
            break
        scale *= 0.97 * int(side) / longer
    vertex_idx, corners, places = atlas[0]
    # triangles without any area are in no chart
    is_placed = atlas.get_mesh_vertex_assignment(0)[0] < atlas.atlas_count
    np.savez(
        target, allow_pickle=False, vertex_idx=vertex_idx.astype(np.int64), faces=corners.astype(np.int32),
        uv=places.astype(np.float32), size=np.array([atlas.width, atlas.height]), scale=np.array(scale),
        num_charts=np.array(atlas.chart_count), is_placed=is_placed,
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
