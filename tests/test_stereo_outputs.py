"""Files of a stereo pair beside maps and cameras: where pixels come from, points of keypoints, what all pairs took."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dense_scenes import CAMERA, poses, wall_with_box_and_bars
from rendered_worlds.rendering import Optics, Renderer
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.rig_writing import write_rig_files
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.formats.sampling_maps import SAMPLING_MAPS, read_sampling_maps, write_sampling_maps
from sfmapp.geometry import rigid3
from sfmapp.reporting import Usage
from sfmapp.scene.rig import Rig
from sfmapp.stereo.rectification import plan_rectification
from sfmapp.workspace.usage import added

BARREL = Camera(CameraModel.OPENCV, 320, 240, np.array([300.0, 300.0, 160.0, 120.0, -0.15, 0.03, 0.0, 0.0]))


def rig() -> Rig:
    turn = rigid3.exp_so3(np.array([0.01, 0.06, -0.02]))
    return Rig((BARREL, CAMERA), np.array([rigid3.IDENTITY, rigid3.from_matrix(turn, -turn @ [0.4, 0.01, 0.0])]))


def test_sampling_maps_come_back_and_opencv_rectifies_by_them(tmp_path: Path) -> None:
    plan = plan_rectification(rig())
    maps = [plan.sampling_map(side).astype(np.float32) for side in (0, 1)]
    maps[0][:3, :5] = np.nan
    plain, opencv = write_sampling_maps(tmp_path, *maps)
    for path in (plain, opencv):
        for ours, read in zip(maps, read_sampling_maps(path), strict=True):
            np.testing.assert_allclose(read, ours, atol=2e-5)
    # a ramp along x is exact under linear interpolation: what OpenCV draws by the maps is where pixels come from
    ramp = np.tile(np.arange(320, dtype=np.float32) + 0.5, (240, 1))
    index = maps[1] - np.float32(0.5)
    drawn = cv2.remap(ramp, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderValue=-1.0)
    inside = ((maps[1] > 2.0) & (maps[1] < [318.0, 238.0])).all(-1)
    np.testing.assert_allclose(drawn[inside], maps[1][inside, 0], atol=0.03)  # OpenCV's steps are 1/32 px


@pytest.mark.parametrize("name", SAMPLING_MAPS)
def test_damaged_maps_are_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be read"):
        read_sampling_maps(tmp_path / name)


def test_a_step_that_is_done_again_takes_what_both_take() -> None:
    first, second = Usage(wall_s=1.0, cpu_s=2.0, peak_memory_mb=5.0), Usage(wall_s=3.0, cpu_s=4.0, peak_memory_mb=6.0)
    assert added(None, first) == first
    assert added(first, second) == Usage(wall_s=4.0, cpu_s=6.0, peak_memory_mb=6.0)


def test_the_command_writes_them_and_points_of_keypoints(tmp_path: Path) -> None:
    world, first = wall_with_box_and_bars(), poses(3)[1]
    for side, (camera, mount) in enumerate(zip(rig().cameras, rig().cam_from_rig, strict=True)):
        pose = rigid3.compose(mount, first)
        for shot in (0, 1):
            picture = Renderer(world, camera).photograph(pose, Optics(noise_sigma=1.0), [shot, side])
            (tmp_path / "lr"[side]).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / "lr"[side] / f"{shot}.png"), picture)
    write_rig_files(tmp_path / "rig", rig(), ("l", "r"))
    out = tmp_path / "out"
    command = ["stereo", str(tmp_path / "l"), str(tmp_path / "r"), "--camera", str(tmp_path / "rig" / "camchain.yaml")]
    assert main([*command, "-o", str(out), "--maps", "--sparse", "-q"]) == 0
    for name in SAMPLING_MAPS:
        left, _ = read_sampling_maps(out / "0" / name)
        assert left.shape[:2] == np.load(out / "0" / "disparity.npy").shape
    header, *rows = (out / "0" / "sparse.csv").read_text().splitlines()
    assert header.split(",")[:4] == ["x", "y", "z", "xx"]
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    assert len(values) > 100
    # their depths against the map's, in their own sigmas
    depth = np.load(out / "0" / "depth.npy")
    column, row = values[:, 9:11].astype(int).T
    off = (values[:, 2] - depth[row, column]) / np.sqrt(values[:, 8])
    assert np.nanmedian(np.abs(off)) < 2.0
    assert (out / "0" / "sparse.ply").is_file()
    assert main([*command, "-o", str(out), "-q"]) == 0
    assert not (out / "0" / "sparse.csv").exists()
    assert not (out / "0" / SAMPLING_MAPS[0]).exists()
