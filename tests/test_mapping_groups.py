"""Groups of photographs of one place that overlap weakly: what waits, what is joined, and what stays apart."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from photo_groups import WIDTH, Place, make_place, thinned
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import join, repair, structure
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.join import find_joint
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import register_image
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, true_correspondences
from sfmapp.scene.tracks import make_tracks

WORLD = np.append(rigid3.from_matrix(rigid3.exp_so3(np.array([0.4, -1.1, 0.3])), [5.0, -2.0, 1.0]), 2.5)


def mapped(place: Place, found=None, threads: int = 1):
    """The models, and what was decided on the way."""
    said: list[str] = []

    def listen(event: Event) -> None:
        if event.kind in ("decided", "warned"):
            said.append(event.message)

    models, report = map_images(
        place.image_set, place.features, place.correspondences if found is None else found, MappingOptions(),
        adjust_options=AdjustOptions(), threads=threads, events=Events(listen),
    )  # fmt: skip
    return models, report, said


def rms_error(model: Reconstruction, ground_truth: Reconstruction, chosen: np.ndarray) -> float:
    """Of the centres of chosen images, aligned on these."""
    a, b = model.centers[chosen], ground_truth.centers[chosen]
    return float(np.sqrt(((similarity.apply(similarity.umeyama(a, b), a) - b) ** 2).sum(1).mean()))


def halves(place: Place, pool: ThreadPoolExecutor, world: np.ndarray = WORLD) -> list[Reconstruction]:
    """The observed ground truth of the first group, and of the others in a world of their own."""
    out = []
    for side in (place.group == 0, place.group > 0):
        model = place.scene.observed.copy()
        model.cam_from_world[~side] = np.nan
        model.point_xyz[:], model.obs_is_inlier[:] = np.nan, False
        structure.triangulate(model, np.arange(model.tracks.num_tracks), MappingOptions(), pool)
        out.append(model)
    out[1].cam_from_world[:] = similarity.transform_poses(world, out[1].cam_from_world)
    out[1].point_xyz[:] = similarity.apply(world, out[1].point_xyz)
    return out


def mapper_with(model: Reconstruction, found, options: MappingOptions, pool: ThreadPoolExecutor, **more) -> Mapper:
    none = np.zeros(len(model.image_names), bool)
    more = {"prior_cameras": list(model.cameras), "locked": none} | more
    return Mapper(
        reconstruction=model, correspondences=found, options=options, adjust_options=AdjustOptions(), events=Events(),
        pool=pool, **more,
    )  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1])
def test_points_that_two_models_see_tell_how_they_lie_to_each_other(seed):
    place = make_place(seed, 2, points=300, overlap=0.2)
    with ThreadPoolExecutor(1) as pool:
        target, source = halves(place, pool)
    joint = find_joint(target, source, place.correspondences, MappingOptions())
    assert joint.reason == ""
    assert joint.num_agreeing > 0.7 * joint.num_links > 70
    error = similarity.compose(joint.target_from_source, WORLD)
    ground_truth = place.scene.ground_truth.centers[place.group == 1]
    # ten metres away and half a pixel over a focal length of a thousand: 5 mm for one point, hundreds average it
    assert 1e-6 < np.linalg.norm(similarity.apply(error, ground_truth) - ground_truth, axis=1).max() < 0.05
    assert error[7] == pytest.approx(1.0, abs=5e-3)


def mirrored(model: Reconstruction, chosen: np.ndarray) -> None:
    """Pictures of some images mirrored from left to right, and the model of what they then show, in place."""
    seen = chosen[model.tracks.obs_image_idx]
    model.tracks.obs_xy[seen, 0] = WIDTH - model.tracks.obs_xy[seen, 0]
    turn = np.diag([-1.0, 1.0, 1.0])
    rotation = turn @ rigid3.rotation_matrix(model.cam_from_world) @ turn
    model.cam_from_world[:] = rigid3.from_matrix(rotation, model.cam_from_world[:, 4:] @ turn)
    model.point_xyz[:, 0] *= -1.0


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("depth", [0.02, 1.5])
def test_a_group_of_mirrored_photographs_is_told_from_a_right_one(seed, depth):
    place = make_place(seed, 2, points=300, overlap=0.3, depth=depth)
    with ThreadPoolExecutor(1) as pool:
        target, source = halves(place, pool)
    assert find_joint(target, source, place.correspondences, MappingOptions()).reason == ""
    mirrored(source, place.group == 1)
    joint = find_joint(target, source, place.correspondences, MappingOptions())
    if depth < 0.1:  # it is the plane, seen from its back: nothing else speaks against that
        assert joint.num_agreeing > 0.7 * joint.num_links
        assert "seen mirrored" in joint.reason
    assert joint.reason


def test_models_that_see_nothing_in_common_stay_apart_and_say_so():
    place = make_place(2, 2, points=300, overlap=-1.2)
    with ThreadPoolExecutor(1) as pool:
        target, source = halves(place, pool)
    joint = find_joint(target, source, place.correspondences, MappingOptions())
    assert "points in common" in joint.reason
    models, report, said = mapped(place)
    assert [int(m.is_registered.sum()) for m in models] == [6, 6]
    assert any("kept apart: they see" in message for message in said)
    for model, other in ((0, 1), (1, 0)):
        assert report["models"][model]["apart"].startswith(f"apart from model {other}: they see")


def test_models_whose_common_points_are_mismatches_stay_apart():
    place = make_place(3, 2, points=300, overlap=0.3)
    with ThreadPoolExecutor(1) as pool:
        target, source = halves(place, pool)
    rng = np.random.default_rng(0)
    both = np.flatnonzero(target.is_triangulated & source.is_triangulated)
    source.point_xyz[both] = source.point_xyz[rng.permutation(both)]
    target.point_xyz[both] = target.point_xyz[rng.permutation(both)]
    joint = find_joint(target, source, place.correspondences, MappingOptions())
    assert "agree on one place" in joint.reason


@pytest.mark.parametrize("seed", [4, 5])
def test_groups_that_overlap_weakly_become_one_model_and_none_is_the_worse_for_it(seed):
    place = make_place(seed, 2, images=5, points=300, overlap=0.2, between=0.3)
    models, report, _ = mapped(place)
    assert [int(m.is_registered.sum()) for m in models] == [10]
    assert report["models"][0]["contradictions"] == []
    everything = np.ones(10, bool)
    # the places are 20 m wide
    assert rms_error(models[0], place.scene.ground_truth, everything) < 0.05
    for g in range(2):
        own = place.group == g
        alone, _, _ = mapped(place, place.of_images(own))
        assert rms_error(models[0], place.scene.ground_truth, own) < 2 * rms_error(
            alone[0], place.scene.ground_truth, own
        )


def test_same_bytes_on_any_number_of_threads_though_focal_lengths_are_searched():
    place = make_place(6, 2, images=4, points=250, overlap=0.3, between=0.6)
    one, two = mapped(place, threads=1)[0][0], mapped(place, threads=2)[0][0]
    assert one.cam_from_world.tobytes() == two.cam_from_world.tobytes()
    assert one.point_xyz.tobytes() == two.point_xyz.tobytes()


def test_the_uncertainty_of_a_new_position_has_the_size_of_its_error():
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 900.0)
    errors, sigmas = [], []
    for seed in range(12):
        scene = make_scene(seed, 6, 400, camera, sigma_px=0.5)
        model = scene.observed.copy()
        model.cam_from_world[0] = np.nan
        # a third of its points, those on the left
        obs = model.tracks.observations_of_image(0)
        x = model.tracks.obs_xy[obs, 0]
        hidden = model.tracks.obs_track_idx[obs[x > np.quantile(x, 1 / 3)]]
        model.point_xyz[hidden] = np.nan
        found = register_image(model, 0, MappingOptions(), max_error_px=4.0, search_focal=True)
        assert found.cam_from_world is not None
        seen = scene.ground_truth.point_xyz[np.setdiff1d(model.tracks.obs_track_idx[obs], hidden)]
        center = scene.ground_truth.centers[0]
        distance = np.median(np.linalg.norm(seen - center, axis=1))
        errors.append(np.linalg.norm(rigid3.center(found.cam_from_world) - center) / distance)
        sigmas.append(found.position_sigma)
    # along the least certain axis, which makes most of the length of the error
    ratio = np.sqrt(np.mean(np.square(np.array(errors) / sigmas)))
    assert 0.5 < ratio < 2.0


def test_a_weak_photograph_waits_for_the_model_of_its_neighbours():
    place = make_place(4, 2, images=5, points=300, overlap=0.2, between=0.3)
    _, _, said = mapped(place)
    waits = [message for message in said if "outside of this model" in message]
    assert waits
    joins = [n for n, message in enumerate(said) if message.startswith("joined two models of 5 and 5")]
    assert joins


def test_a_part_that_hangs_loosely_on_a_model_is_found_and_joined_again():
    place = make_place(7, 2, images=5, points=300, overlap=0.25, between=0.5)
    found, options = place.correspondences, MappingOptions()
    with ThreadPoolExecutor(1) as pool:
        right = place.scene.observed.copy()

        def mapper_of(model: Reconstruction) -> Mapper:
            cameras = list(place.scene.ground_truth.cameras)
            return mapper_with(model, found, options, pool, prior_cameras=cameras)

        mapper_of(right).adjust_globally()
        assert repair.loose_parts(right, options.min_pose_inliers) == []
        # the second group a metre away and a tenth smaller: its points hold for it alone
        wrong = right.copy()
        second = place.group == 1
        shift = similarity.from_parts(rigid3.exp_so3([0.0, 0.05, 0.0]), [1.0, 0.0, 0.5], 0.9)
        wrong.cam_from_world[second] = similarity.transform_poses(shift, wrong.cam_from_world[second])
        structure.triangulate(wrong, np.arange(wrong.tracks.num_tracks), options, pool)
        parts = repair.loose_parts(wrong, options.min_pose_inliers)
        assert len(parts) == 1
        assert parts[0].tolist() in (second.tolist(), (~second).tolist())
        better = repair.repaired(wrong, found, mapper_of, options, Events())
    everything = np.ones(10, bool)
    assert rms_error(wrong, place.scene.ground_truth, everything) > 0.2
    assert rms_error(better, place.scene.ground_truth, everything) < 0.03


def test_an_image_that_its_own_pairs_contradict_is_taken_back():
    place = make_place(8, 1, images=6, points=300)
    model = place.scene.observed.copy()
    model.cam_from_world[2, 4:] += [1.0, 2.0, 0.5]
    with ThreadPoolExecutor(1) as pool:
        attempts: dict = {}
        mapper = mapper_with(model, place.correspondences, MappingOptions(), pool, attempts=attempts)
        structure.filter_observations(model, MappingOptions(), pool)
        assert mapper.drop_contradicted_images()
    assert model.is_registered.tolist() == [True, True, False, True, True, True]
    assert "contradict its pose" in attempts[2].reason


def test_many_matches_under_a_small_angle_start_before_few_under_a_wide_one():
    scene = make_scene(9, 8, 1500, layout="forward", sigma_px=0.3)
    found = true_correspondences(scene)
    angles = np.nan_to_num(found.median_angle_deg)
    far = int(np.argmax(angles))
    assert 4.0 < angles[far] < 8.0
    # the pair of the widest angle keeps 60 matches, the others with less than half its angle keep all
    found = thinned(found, lambda p, m: (np.arange(len(m)) < 60) if p == far else angles[p] < 0.5 * angles[far])
    model = Reconstruction.empty(
        list(scene.ground_truth.cameras),
        scene.ground_truth.image_names,
        scene.ground_truth.image_camera_idx,
        scene.observed.tracks,
    )
    with ThreadPoolExecutor(1) as pool:
        mapper = mapper_with(model, found, MappingOptions(), pool)
        mapper.start(np.ones(8, bool))
    started = model.registered_idx.tolist()
    assert len(started) == 2
    assert started != found.pair_image_idx[far].tolist()


def test_a_scale_that_nothing_tells_ends_no_search() -> None:
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e4])
    assert np.isinf(join._moved(similarity.from_parts(np.eye(3), np.zeros(3), 1.0), step)[7])


def test_a_scale_that_a_few_points_alone_tell_is_not_believed() -> None:
    """All but five common points are seen by one image of the one model, which stays where it is at any scale."""
    place = make_place(0, 2, points=300, overlap=0.2)
    with ThreadPoolExecutor(1) as pool:
        target, source = halves(place, pool)
    assert find_joint(target, source, place.correspondences, MappingOptions()).reason == ""
    tracks = source.tracks
    of_source = source.is_registered[tracks.obs_image_idx]
    seen = [
        np.bincount(tracks.obs_track_idx[side], minlength=tracks.num_tracks) > 0 for side in (of_source, ~of_source)
    ]
    common = np.flatnonzero(seen[0] & seen[1])
    bridge = np.bincount(tracks.obs_image_idx[of_source & np.isin(tracks.obs_track_idx, common)]).argmax()
    gone = of_source & (tracks.obs_image_idx != bridge) & np.isin(tracks.obs_track_idx, common[5:])
    source.point_xyz[common[5:]] = np.nan
    fewer = make_tracks(
        tracks.num_images, tracks.num_tracks, tracks.obs_track_idx[~gone], tracks.obs_image_idx[~gone],
        tracks.obs_feature_idx[~gone], tracks.obs_xy[~gone],
    )  # fmt: skip
    models = [replace(model, tracks=fewer, obs_is_inlier=model.obs_is_inlier[~gone]) for model in (target, source)]
    joint = find_joint(*models, place.correspondences, MappingOptions())
    assert "nothing tells the scale between them" in joint.reason
    assert joint.num_agreeing > 0.6 * joint.num_links
