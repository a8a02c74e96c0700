"""Packages that are not installed: what is said, and that nothing else needs them."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sfmapp import packages
from sfmapp.cli.main import main
from sfmapp.dense.scene import DenseScene
from sfmapp.packages import MissingPackageError, missing_package, require
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.texture import texture_mesh

RARE = ("av", "gtsam", "libusb_package", "mcap", "open3d", "pycolmap", "rerun", "rosbags", "xatlas")


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """An environment in which a package cannot be found."""
    name = str(request.param)
    for module in [module for module in sys.modules if module.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, name, None)
    return name


@pytest.mark.parametrize("without", RARE, indirect=True)
def test_a_missing_package_is_named_with_the_command_that_installs_it(without: str) -> None:
    with pytest.raises(MissingPackageError, match="is not installed") as caught:
        require(without)
    assert caught.value.exit_code == 3
    assert (caught.value.advice or "").startswith("pip install '")
    with pytest.raises(ModuleNotFoundError) as failed:
        __import__(without)
    named = missing_package(failed.value)
    assert named is not None
    assert named.advice == caught.value.advice


def test_packages_that_are_there_are_not_imported() -> None:
    code = (
        f"import sys; from sfmapp.packages import require; require(*{RARE!r}); print(set({RARE!r}) & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_command_asks_for_the_versions_of_the_project() -> None:
    checkout = Path(__file__).resolve().parent.parent
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for distribution, _ in packages._DISTRIBUTIONS.values():
        found = packages._requirement(distribution).replace(" ", "")
        extras = project["optional-dependencies"]
        named = project["dependencies"] + extras["bags"] + extras["cluster"] + extras["geo"]
        (mine,) = (r for r in named if r.partition(">")[0] == distribution)
        # pip and hatchling write the bounds in orders of their own
        assert set(found.replace(distribution, "").split(",")) == set(mine.replace(distribution, "").split(","))


def test_other_modules_are_no_packages_of_ours() -> None:
    assert missing_package(ModuleNotFoundError("No module named 'sfmapp.nothing'", name="sfmapp.nothing")) is None
    assert missing_package(ModuleNotFoundError("No module named 'requests'", name="requests")) is None
    assert missing_package(ModuleNotFoundError("?")) is None


@pytest.mark.parametrize("without", ["rerun"], indirect=True)
def test_view_without_rerun(without: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recording = tmp_path / "recording.rrd"
    recording.write_bytes(b"RRF2")
    assert main(["view", str(recording)]) == 3
    assert "pip install 'rerun-sdk" in capfd.readouterr().err


@pytest.mark.parametrize("without", ["rerun"], indirect=True)
def test_a_run_without_rerun_goes_on_without_a_recording(without: str, tmp_path: Path) -> None:
    from sfmapp.viewer.recording import Drawer

    with Drawer() as drawer:
        problem = drawer.draw("run", tmp_path, tmp_path / "recording.rrd", 1, 10.0)
    assert "pip install 'rerun-sdk" in problem


@pytest.mark.parametrize("without", ["open3d"], indirect=True)
def test_a_mesh_needs_no_open3d_and_its_texture_names_it(without: str, tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(size=(200, 3))
    xyz /= np.linalg.norm(xyz, axis=1, keepdims=True)
    rows = "\n".join(" ".join(f"{v:.6f}" for v in (*p, *p)) for p in xyz)
    head = "\n".join(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz"))
    cloud = tmp_path / "ball.ply"
    cloud.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n{head}\nend_header\n{rows}\n")
    assert main(["mesh", str(cloud), "-o", str(tmp_path / "mesh")]) == 0
    assert (tmp_path / "mesh" / "mesh" / "mesh.ply").is_file()
    corners = np.eye(3)
    mesh = Mesh(corners, np.array([[0, 1, 2]], np.int32), corners.astype(np.float32), np.zeros((3, 3), np.uint8))
    nowhere = DenseScene((), np.zeros((0, 0), np.int32), np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))
    with pytest.raises(MissingPackageError, match="open3d"):
        texture_mesh(mesh, nowhere, SurfaceOptions(texture=True))


@pytest.mark.parametrize(("without", "name"), [("rosbags", "drive.bag"), ("mcap", "drive.mcap")], indirect=["without"])
def test_a_bag_without_what_reads_it(
    without: str, name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(bytes(100))
    command = ["odometry", str(tmp_path / name), "-o", str(tmp_path / "out"), "--camera", "PINHOLE,500,500,320,240"]
    assert main(command) == 3
    assert f"pip install '{without}" in capfd.readouterr().err


@pytest.mark.parametrize("without", ["av"], indirect=True)
def test_a_video_without_av(without: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "film.mp4"
    film.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    command = ["odometry", str(film), "-o", str(tmp_path / "out"), "--camera", "PINHOLE,500,500,320,240"]
    assert main(command) == 3
    assert "pip install 'av" in capfd.readouterr().err
