"""Photographs located in a finished model: exact cases, sigmas that hold, look-alikes that are refused, the command."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import sfmapp
from schemas import check_schema
from sfmapp.adjust.covariance import moved_to_gauge
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.calibration.point_reports import read_pose
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.images.folder import describe_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.pixels import read_gray
from sfmapp.mapping.attach import KnownModel, NewPhotograph
from sfmapp.mapping.locate import Located, LocateOptions, find_candidates, locate_photograph
from sfmapp.mapping.options import MappingOptions
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.pairs import PairOptions
from sfmapp.odometry.belief.photographs import CHANGED_AMONG_LIKES, judge_place
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene
from sfmapp.scene.tracks import make_tracks

OPTIONS = LocateOptions(MatchingOptions(), MappingOptions(), AdjustOptions())
QUERY = 3


def looks(num: int, seed: int = 0) -> np.ndarray:
    """(N, 128) descriptors as far apart as those of different things."""
    rows = np.random.default_rng(seed).gamma(0.3, size=(num, 128))
    return np.rint(512.0 * np.sqrt(rows / rows.sum(1, keepdims=True))).clip(0, 255).astype(np.uint8)


def seen_in(model: Reconstruction, image: int, described: np.ndarray) -> Features:
    """Features of an image, a keypoint for each observation, in their order."""
    obs = model.tracks.observations_of_image(image)
    keypoints = np.zeros((len(obs), 4), np.float32)
    keypoints[:, :2], keypoints[:, 2] = model.tracks.obs_xy[obs], 2.0
    rgb = np.zeros((len(obs), 3), np.uint8)
    return Features(keypoints, described[model.tracks.obs_track_idx[obs]], rgb)


def without(model: Reconstruction, image: int) -> Reconstruction:
    """A model as if one image had never been: the rest in order, and keypoints numbered as :func:`seen_in` has them."""
    tracks = model.tracks
    kept = np.arange(tracks.num_images) != image
    obs = np.flatnonzero(kept[tracks.obs_image_idx])
    feature = np.zeros(tracks.num_observations, np.int64)
    for i in range(tracks.num_images):
        mine = tracks.observations_of_image(i)
        feature[mine] = np.arange(len(mine))
    track, place = tracks.obs_track_idx[obs], (np.cumsum(kept) - 1)[tracks.obs_image_idx[obs]]
    rest = make_tracks(int(kept.sum()), tracks.num_tracks, track, place, feature[obs], tracks.obs_xy[obs])
    length = np.bincount(track, minlength=tracks.num_tracks)
    xyz = np.where((length >= 2)[:, None], model.point_xyz, np.nan)
    return replace(
        model, image_names=[n for n, k in zip(model.image_names, kept, strict=True) if k],
        image_camera_idx=model.image_camera_idx[kept], cam_from_world=model.cam_from_world[kept], tracks=rest,
        point_xyz=xyz, obs_is_inlier=length[rest.obs_track_idx] >= 2,
    )  # fmt: skip


def located(model: Reconstruction, features: list[Features], query: Features, priors=None) -> Located:
    known = KnownModel(model, features, priors or model.cameras)
    photograph = NewPhotograph("new.jpg", query, model.cameras[0], 0)
    with ThreadPoolExecutor(1) as pool:
        return locate_photograph(known, photograph, range(len(features)), OPTIONS, Events(), pool)


def test_a_photograph_is_located_exactly_where_keypoints_are_exact() -> None:
    scene = make_scene(1, 6, 400, sigma_px=0.0)
    described = looks(400)
    rest = without(scene.ground_truth, QUERY)
    features = [seen_in(scene.ground_truth, i, described) for i in range(6)]
    query = features.pop(QUERY)
    found = located(rest, features, query)
    assert found.is_located
    np.testing.assert_allclose(found.cam_from_world, scene.ground_truth.cam_from_world[QUERY], atol=1e-6)
    shows = scene.ground_truth.tracks.obs_track_idx[scene.ground_truth.tracks.observations_of_image(QUERY)]
    assert set(found.track_idx) <= set(shows)
    assert len(found.track_idx) > 0.9 * rest.is_triangulated[shows].sum()
    # the model has not changed
    assert len(rest.image_names) == 5
    assert rest.tracks.num_images == 5


def test_sigmas_hold_and_are_not_too_wide() -> None:
    """NEES of 20 photographs, each left out of a model that was adjusted to noisy keypoints without it."""
    nees = []
    options = AdjustOptions(max_iterations=50, relative_cost_tolerance=1e-10)
    for seed in range(20):
        scene = make_scene(seed, 6, 150, sigma_px=0.4)
        described = looks(150, seed)
        rest = without(scene.observed, QUERY)
        truth = without(scene.ground_truth, QUERY)
        rest.cam_from_world[:], rest.point_xyz[:] = truth.cam_from_world, truth.point_xyz
        rest.point_xyz[np.isnan(truth.point_xyz)] = np.nan
        priors = [replace(camera, focal_source="exif_35mm") for camera in truth.cameras]  # centres are held
        rest.cameras[:] = priors
        adjust_bundle(rest, options, prior_cameras=priors)
        features = [seen_in(scene.observed, i, described) for i in range(6)]
        query = features.pop(QUERY)
        found = located(rest, features, query, priors)
        assert found.is_located, found.reason
        both, known = scene.ground_truth.copy(), scene.ground_truth.copy()
        others = np.delete(np.arange(6), QUERY)
        both.cam_from_world[others], both.cam_from_world[QUERY] = rest.cam_from_world, found.cam_from_world
        true = moved_to_gauge(both, known, others, 7).cam_from_world[QUERY]
        change = rigid3.compose(found.cam_from_world, rigid3.inverse(true))
        error = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(change)), change[4:]])
        nees.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(nees)) / (6 * len(nees))
    assert low < np.mean(nees) / 6 < high


def test_two_places_that_look_alike_are_told_and_not_chosen_from() -> None:
    """Two copies of one scene far apart in one model: a photograph of either fits both."""
    scene = make_scene(2, 6, 300, sigma_px=0.2)
    described = looks(300)
    rest, features = without(scene.ground_truth, QUERY), [seen_in(scene.observed, i, described) for i in range(6)]
    query = features.pop(QUERY)
    away = np.array([40.0, 0.0, 0.0])
    tracks = rest.tracks
    doubled = make_tracks(
        10, 600, np.concatenate([tracks.obs_track_idx, tracks.obs_track_idx + 300]),
        np.concatenate([tracks.obs_image_idx, tracks.obs_image_idx + 5]),
        np.concatenate([tracks.obs_feature_idx, tracks.obs_feature_idx]),
        np.concatenate([tracks.obs_xy, tracks.obs_xy]),
    )  # fmt: skip
    moved = rest.cam_from_world.copy()
    moved[:, 4:] -= rigid3.rotation_matrix(moved) @ away
    twice = replace(
        rest, image_names=[f"{n}.jpg" for n in range(10)], image_camera_idx=np.zeros(10, np.int32),
        cam_from_world=np.concatenate([rest.cam_from_world, moved]), tracks=doubled,
        point_xyz=np.concatenate([rest.point_xyz, rest.point_xyz + away]),
        obs_is_inlier=np.concatenate([rest.obs_is_inlier, rest.obs_is_inlier]),
        point_rgb=np.zeros((600, 3), np.uint8),
    )  # fmt: skip
    found = located(twice, features * 2, query)
    assert not found.is_located
    assert "two places fit" in found.reason
    assert np.isnan(found.cam_from_world).all()
    # with one of the two it is there
    assert located(rest, features, query).is_located


def test_a_photograph_of_something_else_is_not_located_and_the_reason_has_numbers() -> None:
    scene = make_scene(3, 5, 200)
    features = [seen_in(scene.observed, i, looks(200)) for i in range(5)]
    found = located(without(scene.ground_truth, QUERY), features[:QUERY] + features[4:],
                    replace(features[QUERY], descriptors=looks(len(features[QUERY]), seed=9)))  # fmt: skip
    assert not found.is_located
    assert found.reason == "sees 0 points of the map, at least 15 are needed"
    assert found.num_tried == 4
    assert not found.images


def test_in_a_large_model_a_photograph_is_compared_with_those_that_look_alike() -> None:
    """Images of five places, each with descriptors of its own: candidates are those of the photograph's place."""
    places = [looks(300, seed) for seed in range(5)]
    rng = np.random.default_rng(0)

    def of(place: int) -> Features:
        chosen = rng.permutation(300)[:200]
        return Features(np.ones((200, 4), np.float32), places[place][chosen], np.zeros((200, 3), np.uint8))

    images = [of(n % 5) for n in range(40)]
    model = make_scene(0, 40, 60).ground_truth
    options = PairOptions(exhaustive_limit=30, num_neighbors=6)
    known = KnownModel(model, images, model.cameras)
    for place, candidates in enumerate(find_candidates(known, [of(n) for n in range(5)], options, 0)):
        assert len(candidates) == 6
        assert all(image % 5 == place for image in candidates)
    assert find_candidates(known, [of(0)], PairOptions(), 0) == [list(range(40))]


# -------------------------------------------------------------------------------------------------------- photographs


@pytest.fixture(scope="module")
def six(photos, tmp_path_factory) -> tuple[Path, Path]:
    """A workspace of six of seven photographs, and the seventh."""
    folder = tmp_path_factory.mktemp("six")
    names = sorted(path.name for path in photos.iterdir())
    for name in names[:3] + names[4:]:
        (folder / name).write_bytes((photos / name).read_bytes())
    sfmapp.reconstruct(folder, folder / "out", record=False)
    return folder / "out", photos / names[3]


def run(capsys, *words) -> dict:
    code = main([*map(str, words), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document.pop("exit_code") == code
    return document


def test_the_command_locates_what_was_left_out_and_refuses_what_is_elsewhere(
    six, sample, tmp_path, capsys
) -> None:  # fmt: skip
    out, photo = six
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    noise = tmp_path / "noise.png"
    import cv2

    cv2.imwrite(str(noise), np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8))
    found = run(capsys, "locate", photo, noise, "-m", out, "-o", tmp_path / "where")
    del found["output"]
    check_schema("locate-model", found)
    rows = {Path(row["name"]).name: row for row in found["photographs"]}
    row = rows[photo.name]
    assert row["camera_source"] == "a camera of the model"
    assert row["num_points"] > 100
    assert row["landmarks"]["support"] > 20.0
    assert "points" in rows["noise.png"]["reason"]
    assert "pose" not in rows["noise.png"]
    # against the true cameras, in the frame of the model
    model = sfmapp.load(out)
    truth = read_ground_truth(sample / "cameras.json")
    true = {Path(n).stem: p for n, p in zip(truth.names, truth.cam_from_world, strict=True)}
    ours = rigid3.rotation_matrix(np.array(row["pose"]["cam_from_world"]))
    for i in model.registered_idx:
        turn = ours @ rigid3.rotation_matrix(model.cam_from_world[i]).T
        true_turn = rigid3.rotation_matrix(
            rigid3.compose(true[photo.stem], rigid3.inverse(true[Path(model.image_names[i]).stem]))
        )
        assert rigid3.rotation_angle_deg(turn @ true_turn.T) < 0.1
    # the model is as it was
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    page = (tmp_path / "where" / "report.html").read_text(encoding="utf-8")
    assert "1 of 2 photographs located" in page
    pose = read_pose(next((tmp_path / "where" / "poses").glob("*.json")))
    np.testing.assert_allclose(pose.cam_from_world, row["pose"]["cam_from_world"])
    assert len(pose.places) == row["num_points"]


def test_the_same_file_is_told_and_found_without_itself(six, capsys) -> None:
    out, photo = six
    known = sorted(path for path in out.parent.iterdir() if path.suffix == ".png")[2]
    result = sfmapp.locate_photographs(known, out)
    row = result.report.photographs[0]
    assert row.same_as == known.name
    assert row.num_tried == 5
    assert known.name not in row.matched_with
    place = sfmapp.load(out)
    own = place.cam_from_world[place.image_names.index(known.name)]
    shift = rigid3.center(result.photographs[0].cam_from_world) - rigid3.center(own)
    assert np.linalg.norm(shift) < 5.0 * np.sqrt(np.trace(result.photographs[0].center_covariance))
    assert main(["locate", str(photo), "-m", str(out)]) == 0
    assert "1 of 1 photographs located" in capsys.readouterr().out


def test_landmarks_speak_for_the_right_place_and_against_a_turned_one(six) -> None:
    out, photo = six
    found = sfmapp.locate_photographs(photo, out).photographs[0]
    model = sfmapp.load(out)

    def picture_of(image: int) -> np.ndarray:
        return read_gray(describe_images(out.parent, [model.image_names[image]], ImageOptions())[0][0])

    picture = read_gray(describe_images(photo.parent, [photo.name], ImageOptions())[0][0])
    right = judge_place(model, found.cam_from_world, found.camera, picture, picture_of)
    assert right.support > 20.0
    assert not right.is_contradicted_beyond(CHANGED_AMONG_LIKES)
    aside = rigid3.compose(
        rigid3.from_matrix(rigid3.exp_so3(np.array([0.0, 0.1, 0.0])), np.zeros(3)), found.cam_from_world
    )
    wrong = judge_place(model, aside, found.camera, picture, picture_of)
    assert wrong.support < 0.0
    assert wrong.is_contradicted_beyond(CHANGED_AMONG_LIKES)
    # without photographs nothing is said
    assert judge_place(model, aside, found.camera, picture, lambda _: None).num_clusters == 0


def test_what_is_not_a_model_or_no_photograph_is_named(six, tmp_path, capsys) -> None:
    out, photo = six
    (tmp_path / "text.jpg").write_text("no photograph")
    assert main(["locate", str(tmp_path / "text.jpg"), "-m", str(out)]) == 3
    assert "text.jpg" in capsys.readouterr().err
    assert main(["locate", str(photo), "-m", str(tmp_path)]) == 3
    assert (
        main(["locate", str(photo), str(photo), "--points", "x.csv", "--camera", "c", "-o", str(tmp_path / "o")]) == 2
    )
    assert main(["locate", str(photo), "-m", str(out), "--points", "x.csv"]) == 2
    with pytest.raises(InputError, match="not a workspace"):
        sfmapp.locate_photographs(photo, tmp_path / "nowhere")
