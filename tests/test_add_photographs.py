"""Photographs added to a finished reconstruction: what is kept, what is told, and that nothing is lost on the way."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from sfmapp.cli.main import main
from sfmapp.errors import InterruptedRunError, UsageError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.events import Event, Events
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.mapping.carry import carried
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene
from sfmapp.scene.tracks import make_tracks


def contents(folder: Path) -> dict[str, bytes]:
    """Files of a workspace, but for what is made beside it and the links to photographs."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not {".adding", "photographs", ".lock"} & set(path.relative_to(folder).parts)
    }


def test_a_model_is_carried_over_to_tracks_of_more_images() -> None:
    """Points are where they were, whatever their tracks are called; split ones twice, joined ones once."""
    scene = make_scene(0, 6, 80, sigma_px=0.0).ground_truth
    tracks, rng = scene.tracks, np.random.default_rng(0)
    renamed = rng.permutation(80)
    other = make_tracks(
        6, 80, renamed[tracks.obs_track_idx], tracks.obs_image_idx, tracks.obs_feature_idx, tracks.obs_xy
    )  # fmt: skip
    order = rng.permutation(6)
    inverse = np.argsort(order)
    mixed = make_tracks(
        6, 80, other.obs_track_idx, inverse[other.obs_image_idx], other.obs_feature_idx, other.obs_xy
    )  # fmt: skip
    empty = Reconstruction.empty(
        scene.cameras, [scene.image_names[i] for i in order], scene.image_camera_idx[order], mixed
    )  # fmt: skip
    part = scene.copy()
    part.cam_from_world[5] = np.nan
    part.obs_is_inlier &= tracks.obs_image_idx != 5
    lengths = np.bincount(tracks.obs_track_idx[part.obs_is_inlier], minlength=80)
    part.point_xyz[lengths < 2] = np.nan
    part.obs_is_inlier &= lengths[tracks.obs_track_idx] >= 2
    found = carried(part, empty)
    np.testing.assert_array_equal(found.cam_from_world[inverse], part.cam_from_world)
    np.testing.assert_array_equal(found.point_xyz[renamed], part.point_xyz)
    assert not found.obs_is_inlier.any()
    assert np.isnan(empty.cam_from_world).all()
    # a track of three images or more that falls apart in two is in one place still
    split = np.flatnonzero(lengths >= 4)[0]
    mine = np.flatnonzero(tracks.obs_track_idx == split)
    apart = tracks.obs_track_idx.astype(np.int64).copy()
    apart[mine[: len(mine) // 2]] = 80
    in_two = make_tracks(6, 81, apart, tracks.obs_image_idx, tracks.obs_feature_idx, tracks.obs_xy)
    both = carried(part, Reconstruction.empty(scene.cameras, scene.image_names, scene.image_camera_idx, in_two))
    np.testing.assert_array_equal(both.point_xyz[split], both.point_xyz[80])
    np.testing.assert_array_equal(both.point_xyz[split], part.point_xyz[split])


@pytest.fixture(scope="module")
def begun(photos, tmp_path_factory) -> tuple[Path, Path, Path]:
    """A workspace of four photographs, three more in another folder, and a file of noise there."""
    folder = tmp_path_factory.mktemp("begun")
    first, more = folder / "first", folder / "more"
    names = sorted(path.name for path in photos.iterdir())
    for place, some in ((first, names[:4]), (more, names[4:6])):
        place.mkdir()
        for name in some:
            shutil.copyfile(photos / name, place / name)
    shutil.copyfile(photos / names[1], more / "again.png")
    cv2.imwrite(str(more / names[0]), np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8))
    cv2.imwrite(str(more / "noise.png"), np.random.default_rng(1).integers(0, 255, (300, 400, 3), np.uint8))
    sfmapp.reconstruct(first, folder / "out", record=False)
    return folder / "out", more, photos / names[6]


@pytest.fixture
def workspace(begun, tmp_path) -> tuple[Path, Path, Path]:
    out, more, last = begun
    shutil.copytree(out, tmp_path / "out")
    return tmp_path / "out", more, last


def test_photographs_are_added_and_what_is_there_is_told(workspace, photos, sample, capsys) -> None:
    out, more, last = workspace
    before = sfmapp.load(out)
    model, report = sfmapp.reconstruct(more, out, add=True, record=False)
    names = sorted(path.name for path in photos.iterdir())
    assert sorted(model.image_names) == names[:6]
    added = report.added
    assert {one.name: one.model for one in added.photographs} == {names[4]: 0, names[5]: 0, "noise.png": None}
    assert [one.reason for one in added.photographs if one.name == "noise.png"] == [
        "shares too few verified matches with any model"
    ]
    assert {one.name: one.reason for one in added.known} == {
        "again.png": f"is there already, as {names[1]}",
        names[0]: "another photograph of that name is there already: rename this one to add it",
    }
    # what was computed is kept
    assert report.stages.features.num_known == 4
    assert report.stages.matching.num_resumed_pairs == added.num_known_pairs == 6
    assert added.num_pairs == 21
    # names are those of links in the workspace, which other commands find
    manifest = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert manifest["image_root"] == str(out / "photographs")
    assert (out / "photographs" / names[4]).read_bytes() == (photos / names[4]).read_bytes()
    assert not (out / ".adding").exists()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<h2>Added</h2>" in page
    assert "another photograph of that name" in page
    # as good as all at once
    truth = read_ground_truth(sample / "cameras.json")
    true = {Path(n).stem: p for n, p in zip(truth.names, truth.cam_from_world, strict=True)}
    wanted = np.array([true[Path(name).stem] for name in names[:6]])
    whole, _ = sfmapp.reconstruct(photos, out.parent / "whole", record=False)
    errors = [
        np.nanmean(evaluate_poses(one.image_names, one.cam_from_world, names[:6], wanted).center_error)
        for one in (model, whole)
    ]
    assert errors[0] < 1.25 * errors[1]
    assert len(before.image_names) == 4
    # once more: nothing to do; one more photograph: it goes on
    assert main(["reconstruct", str(more), "-o", str(out), "--add", "--no-recording"]) == 0
    assert "up to date" in capsys.readouterr().out
    assert main(["reconstruct", str(last.parent), "-o", str(out), "--add", "--no-recording"]) == 0
    shown = capsys.readouterr().out
    assert "7 of 8 images registered" in shown
    assert "1 of 1 photographs" in shown
    # the first command would lose what was added
    with pytest.raises(UsageError, match="were added to"):
        sfmapp.reconstruct(more, out, record=False)
    assert len(sfmapp.load(out).image_names) == 7


class Stopper:
    """Asks a run to stop where mapping begins."""

    def __init__(self, events: Events) -> None:
        self.events = events

    def __call__(self, event: Event) -> None:
        if event.stage == "mapping" and event.kind == "started":
            self.events.cancel()


def test_an_interrupted_call_leaves_all_as_it_was_and_the_next_one_goes_on(workspace) -> None:
    out, more, _ = workspace
    before = contents(out)
    events = Events()
    events.subscribe(Stopper(events))
    with pytest.raises(InterruptedRunError):
        sfmapp.reconstruct(more, out, add=True, record=False, events=events)
    assert contents(out) == before
    assert len(sfmapp.load(out).image_names) == 4
    model, report = sfmapp.reconstruct(more, out, add=True, record=False)
    assert len(model.image_names) == 6
    assert report.stages.features.num_known == 7
    assert report.stages.matching.num_resumed_pairs == 21


def test_results_that_were_whole_take_their_place_after_a_cut(workspace, photos) -> None:
    """A machine that goes down among the renamings: the next call finishes them."""
    out, more, _ = workspace
    shutil.copytree(out, out.parent / "other")
    model, _ = sfmapp.reconstruct(more, out.parent / "other", add=True, record=False)
    made = out / ".adding"
    shutil.copytree(out.parent / "other", made, symlinks=True)
    (made / "ready").touch()
    (made / "database.db").replace(out / "database.db")
    _, report = sfmapp.reconstruct(more, out, add=True, record=False)
    assert report.run.is_up_to_date
    assert sfmapp.load(out).image_names == model.image_names
    assert not made.exists()


def test_options_that_differ_are_named_and_nothing_is_touched(workspace, capsys) -> None:
    out, more, _ = workspace
    before = contents(out)
    code = main([
        "reconstruct", str(more), "-o", str(out), "--add", "--set", "features.max_num_features=500", "--seed", "3",
    ])  # fmt: skip
    assert code == 2
    told = capsys.readouterr().err
    assert "features.max_num_features = 500 (it was made with 8192)" in told
    assert "seed = 3 (it was made with 0)" in told
    assert contents(out) == before


def test_what_cannot_be_added_to_is_named(tmp_path, photos, workspace) -> None:
    out, more, _ = workspace
    assert main(["reconstruct", str(more), "-o", str(tmp_path / "none"), "--add"]) == 3
    assert not (tmp_path / "none").exists()
    with pytest.raises(UsageError, match="as files"):
        sfmapp.reconstruct({"a": np.zeros((32, 32), np.uint8)}, out, add=True)
