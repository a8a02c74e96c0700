"""Two finished reconstructions as one: what they share joins them, what does not agree is refused and named."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from sfmapp.cli.main import main
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.report import ImageSigmas, Uncertainty
from sfmapp.pipelines.sparse.merge import disagreement
from sfmapp.scene.synthetic import make_scene


def test_models_agree_up_to_a_similarity_and_disagree_beyond_their_sigmas() -> None:
    first = make_scene(0, 8, 60).ground_truth
    turn = similarity.from_parts(rigid3.exp_so3(np.array([0.3, -0.2, 1.0])), np.array([5.0, -2.0, 1.0]), 3.0)
    rng = np.random.default_rng(0)

    def told(sigma: float, sigma_deg: float) -> Uncertainty:
        each = ImageSigmas(center_sigma_share=sigma, rotation_sigma_deg=sigma_deg)
        return Uncertainty(images=dict.fromkeys(first.image_names, each))

    centers = first.centers
    size = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    other = first.copy()
    for i in range(8):  # turned about their centres, and moved, by noise of half of the variance each
        change = rigid3.from_matrix(
            rigid3.exp_so3(np.radians(0.1) * rng.normal(size=3)), 0.001 * size * rng.normal(size=3)
        )  # fmt: skip
        other.cam_from_world[i] = rigid3.compose(change, first.cam_from_world[i])
    other.cam_from_world[:] = similarity.transform_poses(turn, other.cam_from_world)
    half = told(0.001 / np.sqrt(2.0), 0.1 / np.sqrt(2.0))
    found = disagreement(first, other, half, half)
    assert found is not None
    assert found.num_shared == 8
    assert found.num_off == 0
    assert not found.is_refused
    # a similarity takes seven of 48 numbers off; the larger of shifts and turns
    assert 0.6 < found.sigmas < 1.5
    # three of eight photographs in other places are too many
    bent = other.copy()
    bent.cam_from_world[:3, 4:] += 0.5 * 3.0 * size * rng.normal(size=(3, 3))
    found = disagreement(first, bent, half, half)
    assert found.is_refused
    assert found.num_off == 3
    assert "standard deviations" in found.text
    # what both have is too little to tell
    other.cam_from_world[2:] = np.nan
    assert disagreement(first, other, half, half) is None


@pytest.fixture(scope="module")
def parts(photos, tmp_path_factory) -> dict[str, Path]:
    """Workspaces of the first five of seven photographs, the last five, the last three, and of mirror images."""
    folder = tmp_path_factory.mktemp("parts")
    names = sorted(path.name for path in photos.iterdir())
    found = {}
    for part, some in (("first", names[:5]), ("last", names[2:]), ("end", names[4:]), ("mirrored", names[:4])):
        (folder / f"photos of {part}").mkdir()
        for name in some:
            if part == "mirrored":
                picture = cv2.imread(str(photos / name))
                cv2.imwrite(str(folder / f"photos of {part}" / name), np.ascontiguousarray(picture[:, ::-1]))
            else:
                shutil.copyfile(photos / name, folder / f"photos of {part}" / name)
        found[part] = folder / part
        sfmapp.reconstruct(folder / f"photos of {part}", found[part], record=False)
    return found


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def mean_error(model, sample: Path) -> float:
    truth = read_ground_truth(sample / "cameras.json")
    true = {Path(n).stem: p for n, p in zip(truth.names, truth.cam_from_world, strict=True)}
    names = list(model.image_names)
    found = evaluate_poses(names, model.cam_from_world, names, np.array([true[Path(name).stem] for name in names]))
    return float(np.mean(found.center_error))


def test_two_models_that_share_photographs_become_one(parts, photos, sample, tmp_path, capsys) -> None:
    before = [contents(parts[name]) for name in ("first", "last")]
    model, report = sfmapp.merge(parts["first"], parts["last"], tmp_path / "both", record=False)
    assert sorted(model.image_names) == sorted(path.name for path in photos.iterdir())
    assert len(report.models) == 1
    assert report.merged.num_shared == 3
    assert report.merged.num_images == [5, 5]
    assert 0.0 < report.merged.off_sigmas < 10.0
    # nothing of both is done again but what had no order: ten pairs each, three of them in both
    assert report.stages.features.num_known == 7
    assert report.stages.matching.num_resumed_pairs == 17
    whole, _ = sfmapp.reconstruct(photos, tmp_path / "whole", record=False)
    assert mean_error(model, sample) < 1.25 * mean_error(whole, sample)
    assert [contents(parts[name]) for name in ("first", "last")] == before
    assert "<h2>Merged</h2>" in (tmp_path / "both" / "report.html").read_text(encoding="utf-8")


def test_two_models_that_share_no_photograph_are_joined_by_what_both_see(parts, sample, tmp_path, capsys) -> None:
    first = tmp_path / "four"
    shutil.copytree(parts["first"].parent / "photos of first", tmp_path / "some")
    sorted((tmp_path / "some").iterdir())[-1].unlink()
    sfmapp.reconstruct(tmp_path / "some", first, record=False)
    assert main(["merge", str(first), str(parts["end"]), "-o", str(tmp_path / "both"), "--no-recording"]) == 0
    shown = capsys.readouterr().out
    assert "7 of 7 images registered" in shown
    assert "0 photographs were in both" in shown
    assert mean_error(sfmapp.load(tmp_path / "both"), sample) < 0.01


def test_what_has_nothing_in_common_is_not_made_one(parts, tmp_path, capsys) -> None:
    code = main(["merge", str(parts["first"]), str(parts["mirrored"]), "-o", str(tmp_path / "both"), "--no-recording"])
    assert code == 4
    assert "mirrored has no part in the model" in capsys.readouterr().err


def test_models_that_contradict_each_other_are_refused(parts, tmp_path, capsys) -> None:
    """Of the second one shared photographs have changed places."""
    wrong = tmp_path / "wrong"
    shutil.copytree(parts["last"], wrong)
    model, keypoints = read_model(wrong / "sparse" / "0")
    model.cam_from_world[:3] = model.cam_from_world[[1, 2, 0]]
    write_model(wrong / "sparse" / "0", model, keypoints)
    assert main(["merge", str(parts["first"]), str(wrong), "-o", str(tmp_path / "both"), "--no-recording"]) == 4
    told = capsys.readouterr().err
    assert "do not agree" in told
    assert "3 shared photographs are elsewhere" in told


def test_what_is_no_reconstruction_is_named(parts, tmp_path, capsys) -> None:
    assert main(["merge", str(parts["first"]), str(tmp_path), "-o", str(tmp_path / "both")]) == 3
    assert main(["merge", str(parts["first"]), str(parts["first"]), "-o", str(tmp_path / "both")]) == 2
    assert "twice" in capsys.readouterr().err
