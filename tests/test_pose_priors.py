"""Poses that are known beforehand: as priors of the adjustment, and held."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas import check_schema
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.events import Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.poses.fit import known_poses, robust_pose_fit
from sfmapp.georeference.poses.held import judge_held_poses
from sfmapp.georeference.poses.options import PoseOptions
from sfmapp.georeference.poses.positions import with_positions
from sfmapp.georeference.poses.report import PosesReport
from sfmapp.georeference.poses.stage import PoseFile, pose_models
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.position import Position
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.synthetic import SyntheticScene, make_scene, synthetic_camera, true_correspondences

NUM = 8
# of known places, in units of the scene, whose cameras are some four units from it, and of known rotations
SIGMA, SIGMA_DEG = 0.02, 0.3


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as made:
        yield made


def scene_of(seed: int) -> SyntheticScene:
    camera = replace(synthetic_camera(CameraModel.PINHOLE), is_fixed=True)
    return make_scene(seed, NUM, 150, camera, sigma_px=0.5)


def finished_map(scene: SyntheticScene, pool: Executor, seed: int = 0) -> Mapper:
    """A map as photographs alone give it, in a gauge of its own."""
    model, rng = scene.observed.copy(), np.random.default_rng([seed, 5])
    gauge = np.append(rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3)), 0.2)
    model.cam_from_world[:] = similarity.transform_poses(gauge, model.cam_from_world)
    model.point_xyz[:] = similarity.apply(gauge, model.point_xyz)
    mapper = Mapper(
        reconstruction=model, correspondences=true_correspondences(scene), options=MappingOptions(),
        adjust_options=AdjustOptions(), events=Events(), pool=pool, prior_cameras=list(model.cameras),
        locked=np.zeros(NUM, bool),
    )  # fmt: skip
    mapper.polish()
    return mapper


def noisy_poses(scene: SyntheticScene, seed: int, share: float = 1.0) -> np.ndarray:
    rng, truth = np.random.default_rng([seed, 6]), scene.ground_truth.cam_from_world
    rotation = rigid3.exp_so3(share * np.radians(SIGMA_DEG) * rng.normal(size=(NUM, 3))) @ rigid3.rotation_matrix(truth)
    centers = rigid3.center(truth) + share * SIGMA * rng.normal(size=(NUM, 3))
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def pose_file(poses: np.ndarray, *, is_stated: bool = False, fixed: bool = False) -> PoseFile:
    sigmas = (SIGMA, SIGMA_DEG) if is_stated else (None, None)
    return PoseFile(Path("poses.txt"), poses, 0, PoseOptions("poses.txt", *sigmas, fixed))


def adjusted(
    scene: SyntheticScene, poses: np.ndarray, pool: Executor, *, is_stated: bool = False, seed: int = 0
) -> tuple[PosesReport, np.ndarray]:
    mapper = finished_map(scene, pool, seed)
    report = pose_models([mapper], pose_file(poses, is_stated=is_stated), Events())
    return report, mapper.reconstruction.cam_from_world


def test_a_similarity_to_exact_poses_is_exact() -> None:
    scene = scene_of(0)
    known = known_poses(np.arange(NUM), scene.ground_truth.cam_from_world, None, None)
    gauge = np.append(rigid3.from_matrix(rigid3.exp_so3([0.3, -1.0, 2.0]), [1.0, 2.0, 3.0]), 0.1)
    fit = robust_pose_fit(similarity.transform_poses(gauge, known.cam_from_world), known)
    assert fit is not None
    np.testing.assert_allclose(similarity.compose(fit.world_from_model, gauge)[4:], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    assert fit.is_inlier.all()
    one_place = known_poses(np.arange(2), np.repeat(known.cam_from_world[:1], 2, 0), 1.0, 0.1)
    assert robust_pose_fit(known.cam_from_world[:2], one_place) is None


def test_exact_poses_bring_frame_and_scale(pool: Executor) -> None:
    scene = scene_of(1)
    report, found = adjusted(scene, scene.ground_truth.cam_from_world, pool)
    truth = scene.ground_truth.cam_from_world
    row = report.models[0]
    assert row.num_used == row.num_known == NUM
    assert row.sigma is not None
    # photographs alone are off by as much as the poses seem to be, and poses take away more than half of that
    off = [image.off for image in report.images if image.off is not None]
    assert np.linalg.norm(rigid3.center(found) - rigid3.center(truth), axis=1).max() < 0.5 * max(off) < 0.01
    assert row.sigma < max(off)


@pytest.mark.parametrize("is_stated", [True, False])
def test_squares_of_right_poses_are_six_on_average(pool: Executor, is_stated: bool) -> None:
    squares, factors = [], []
    for seed in range(6):
        scene = scene_of(seed)
        report, found = adjusted(scene, noisy_poses(scene, seed), pool, is_stated=is_stated, seed=seed)
        assert all(row.is_used for row in report.images)
        squares += [row.sigmas**2 for row in report.images if row.sigmas is not None]
        row = report.models[0]
        assert row.sigma is not None
        assert row.sigma_deg is not None
        factors.append([row.sigma / SIGMA, row.sigma_deg / SIGMA_DEG])
        off = np.linalg.norm(rigid3.center(found) - rigid3.center(scene.ground_truth.cam_from_world), axis=1)
        assert off.max() < 3 * SIGMA  # the mean of eight, as a whole
    # 48 poses less the seven numbers of each fit, three standard deviations
    assert abs(np.mean(squares) - 6.0 * 41 / 48) < 3 * 6.0 * np.sqrt(2 / 246)
    np.testing.assert_allclose(np.mean(factors, axis=0), 1.0, atol=0.2)


@pytest.mark.parametrize("size", [0.2, 2.0])
def test_a_wrong_pose_is_named_and_bends_nothing(pool: Executor, size: float) -> None:
    for seed in range(2):
        scene = scene_of(seed)
        poses = noisy_poses(scene, seed)
        _, before = adjusted(scene, poses, pool, seed=seed)
        wrong = poses.copy()
        turn = rigid3.exp_so3([0.0, np.radians(20 * size), 0.0]) @ rigid3.rotation_matrix(wrong[3])
        wrong[3] = rigid3.from_matrix(turn, -turn @ (rigid3.center(wrong[3]) + np.array([size, 0.0, 0.0])))
        report, after = adjusted(scene, wrong, pool, seed=seed)
        assert [row.name for row in report.images if not row.is_used] == [scene.observed.image_names[3]]
        assert report.images[3].off == pytest.approx(size, abs=0.1)
        assert "from its known pose" in report.images[3].reason
        assert np.linalg.norm(rigid3.center(after) - rigid3.center(before), axis=1).max() < SIGMA


def test_some_poses_do_and_one_does_not(pool: Executor) -> None:
    scene = scene_of(2)
    poses = noisy_poses(scene, 2, share=0.1)
    poses[[1, 3, 4, 6]] = np.nan
    report, found = adjusted(scene, poses, pool)
    assert [row.is_used for row in report.images] == [True] * 4
    off = np.linalg.norm(rigid3.center(found) - rigid3.center(scene.ground_truth.cam_from_world), axis=1)
    assert off.max() < 0.02
    poses[1:] = np.nan
    report, _ = adjusted(scene, poses, pool)
    assert "two are needed" in report.models[0].reason


def test_poses_of_another_convention_are_refused(pool: Executor) -> None:
    scene = scene_of(3)
    report, _ = adjusted(scene, rigid3.inverse(scene.ground_truth.cam_from_world), pool)
    assert report.models[0].reason
    assert not any(row.is_used for row in report.images)


def test_a_held_pose_that_photographs_refute_is_let_go(pool: Executor) -> None:
    """Photographs alone tell a place within some 0.01: a pose that is off by 0.1 is wrong."""
    scene = scene_of(4)
    mapper = finished_map(scene, pool)
    model, truth = mapper.reconstruction, scene.ground_truth.cam_from_world
    wrong = truth.copy()
    wrong[5, 4:] += [0.1, 0.0, 0.0]
    model.cam_from_world[:], model.point_xyz[:] = wrong, scene.ground_truth.point_xyz
    mapper.held = np.ones(NUM, bool)
    report = judge_held_poses(mapper, pose_file(wrong, fixed=True), Events())
    assert [row.name for row in report.images if not row.is_used] == [model.image_names[5]]
    assert (model.cam_from_world[mapper.held] == wrong[mapper.held]).all()
    assert np.linalg.norm(rigid3.center(model.cam_from_world[5]) - rigid3.center(truth[5])) < 0.03
    assert model.is_triangulated.all()


def held_report(scene: SyntheticScene, poses: np.ndarray, pool: Executor) -> PosesReport:
    mapper = finished_map(scene, pool)
    mapper.reconstruction.cam_from_world[:] = poses
    mapper.reconstruction.point_xyz[:] = scene.ground_truth.point_xyz
    mapper.held = np.ones(NUM, bool)
    return judge_held_poses(mapper, pose_file(poses, fixed=True), Events())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poses_that_are_all_a_little_off_are_contradicted_where_they_are_held(pool: Executor, seed: int) -> None:
    """No pose stands out, and all look as good as each other; but points made of them do not agree."""
    scene = scene_of(seed)
    right = held_report(scene, scene.ground_truth.cam_from_world, pool)
    assert not right.contradictions
    assert max(row.sigmas for row in right.images if row.sigmas is not None) < 4.7
    wrong = held_report(scene, noisy_poses(scene, seed), pool)
    (found,) = wrong.contradictions
    assert found.subject == "held poses"
    assert "sigmas" in found.message
    assert float(str(found.evidence["held_out_residual_ratio"])) < 0.5
    # 0.3 degrees and 0.02 units, as eight poses tell it
    assert found.rotation_sigma_deg == pytest.approx(SIGMA_DEG, rel=0.5)
    names = found.evidence["images"]
    assert isinstance(names, list)
    assert names


def test_held_poses_tell_what_exif_says_wrongly_of_a_camera(pool: Executor) -> None:
    """A focal length that is off by four of its sigmas, and a principal point that EXIF knows nothing of, speak neither
    for nor against poses that are held."""
    true_camera = synthetic_camera(CameraModel.SIMPLE_RADIAL)
    focal, *center = true_camera.params[:3].tolist()
    true_camera = true_camera.with_params([focal, center[0] - 0.04 * true_camera.width, *true_camera.params[2:]])
    scene = make_scene(3, NUM, 300, true_camera, sigma_px=0.3)
    mapper = finished_map(scene, pool)
    model = mapper.reconstruction
    exif = replace(
        true_camera.with_params([1.2 * focal, *center, 0.0]), focal_sigma=0.05 * focal, focal_source="exif_35mm"
    )
    model.cameras[:], mapper.prior_cameras[:] = [exif], [exif]
    model.cam_from_world[:], model.point_xyz[:] = scene.ground_truth.cam_from_world, np.nan
    mapper.held, mapper.poses_tell_centers = np.ones(NUM, bool), True
    mapper.max_error_px = mapper.options.max_pose_error_px
    mapper.triangulate_images(list(range(NUM)))
    mapper.adjust_globally()
    mapper.finish()
    np.testing.assert_allclose(model.cameras[0].params[:3], true_camera.params[:3], atol=2.0)
    report = judge_held_poses(mapper, pose_file(scene.ground_truth.cam_from_world, fixed=True), Events())
    assert not report.contradictions
    assert all(row.is_used for row in report.images)


def positioned(scene: SyntheticScene, metres: float, seed: int, wrong: int = 0) -> ImageSet:
    """Photographs with positions to two centimetres of a scene whose unit has so many metres; some far away."""
    rng, place = np.random.default_rng([seed, 7]), LocalFrame(48.2, 16.4, 170.0)
    at = metres * rigid3.center(scene.ground_truth.cam_from_world) + 0.02 * rng.normal(size=(NUM, 3))
    at[:wrong] += 300.0 * rng.normal(size=(wrong, 3))
    positions = [
        Position(latitude, longitude, height, "ellipsoidal", 0.02, 0.02, True)
        for latitude, longitude, height in place.geodetic_from_enu(at).tolist()
    ]
    records = [
        ImageRecord(name, Path(name), 1000, 750, position=position)
        for name, position in zip(scene.observed.image_names, positions, strict=True)
    ]
    return ImageSet(tuple(records), tuple(scene.observed.cameras))


@pytest.mark.parametrize(
    ("metres", "wrong", "said"),
    [
        (1.0, 0, ""),
        (1.1, 0, "sigmas from a metre"),
        (0.3048, 0, ""),
        (1.0, 3, ""),
        (1.0, 5, "positions of photographs"),
    ],
)
def test_positions_are_held_against_known_poses(pool: Executor, metres: float, wrong: int, said: str) -> None:
    for seed in range(3):
        scene = scene_of(seed)
        mapper = finished_map(scene, pool, seed)
        report = pose_models([mapper], pose_file(noisy_poses(scene, seed)), Events())
        before = mapper.reconstruction.cam_from_world.copy()
        image_set = positioned(scene, metres, seed, wrong)
        report = with_positions(report, [mapper.reconstruction], image_set, GpsOptions(), Events())
        assert (mapper.reconstruction.cam_from_world == before).all()
        found = report.models[0].positions
        assert found is not None
        assert found.unit_m is not None
        assert found.unit_sigma_m is not None
        assert [said in one.message for one in report.contradictions] == [True] * bool(said)
        if wrong < NUM / 2:
            assert found.num_agreeing == NUM - wrong
            assert set(found.disagreeing) == set(scene.observed.image_names[:wrong])
            # cameras some four units from the middle, known to 2 cm, and poses that make the unit as good
            assert abs(found.unit_m / metres - 1.0) < 4 * np.hypot(found.unit_sigma_m / metres, 0.02 / 4)
            assert "one unit is" in found.sentence
    few = ImageSet(image_set.images[:2], image_set.cameras)
    found = with_positions(report, [mapper.reconstruction], few, GpsOptions(), Events()).models[0].positions
    assert found is not None
    assert "three are needed" in found.sentence


def write_cameras(path: Path, sample: Path, num: int, wrong: int | None) -> dict[str, np.ndarray]:
    """``cameras.json`` of the first photographs of the sample, under names of other folders and suffixes, and one that
    is of none; returns the poses by stem."""
    truth = read_ground_truth(sample / "cameras.json")
    rows, poses = [], {}
    for n in range(num):
        pose, name = truth.cam_from_world[n].copy(), Path(truth.names[n]).stem
        poses[name] = pose
        if n == wrong:
            pose = pose + np.array([0, 0, 0, 0, 0.4, 0.0, 0.3])
        rotation = rigid3.rotation_matrix(pose).tolist()
        rows.append({"file": f"survey/{name}.tif", "R_w2c": rotation, "t_w2c": pose[4:].tolist()})
    rows.append({"file": "survey/none.tif", "R_w2c": np.eye(3).tolist(), "t_w2c": [0.0, 0.0, 0.0]})
    path.write_text(json.dumps({"cameras": rows}))
    return poses


def test_the_command_line_holds_poses_and_takes_them_as_priors(
    sample: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six of seven photographs have a pose, of which the third is wrong: the others are held to the last bit."""
    poses = write_cameras(tmp_path / "cameras.json", sample, 6, 2)
    out = tmp_path / "out"
    command = ["reconstruct", str(photos), "-o", str(out), "--pose-priors", str(tmp_path / "cameras.json")]
    assert main([*command, "--fix-poses", "--no-recording"]) == 0
    shown = capsys.readouterr().out
    assert "1 poses of" in shown
    model = read_model(out / "sparse" / "0")[0]
    assert model.is_registered.all()
    names = [Path(name).stem for name in model.image_names]
    for i in (0, 1, 3, 4, 5):
        # single digits are lost on the way through a matrix
        np.testing.assert_allclose(model.cam_from_world[i], poses[names[i]], atol=1e-12)
    assert np.linalg.norm(model.centers[2] - rigid3.center(poses[names[2]])) < 0.02
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    rows = report["stages"]["poses"]["images"]
    assert [row["is_used"] for row in rows] == [True, True, False, True, True, True]
    assert main([*command, "--no-recording", "-q"]) == 0
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    rows = report["stages"]["poses"]["images"]
    assert [row["is_used"] for row in rows] == [True, True, False, True, True, True]
    model = read_model(out / "sparse" / "0")[0]
    centers = np.array([rigid3.center(poses[name]) for name in names[:6]])
    assert np.linalg.norm(model.centers[:6] - centers, axis=1).max() < 0.02
    assert "Known poses" in (out / "report.html").read_text()


def test_what_cannot_be_is_refused(
    sample: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cameras(tmp_path / "cameras.json", sample, 1, None)
    command = ["reconstruct", str(photos), "-o", str(tmp_path / "out"), "-q"]
    assert main([*command, "--fix-poses"]) == 2
    assert "--pose-priors FILE" in capsys.readouterr().err
    assert main([*command, "--pose-priors", str(tmp_path / "cameras.json"), "--up", "exif"]) == 2
    assert "both set the frame of the models" in capsys.readouterr().err
    assert main([*command, "--pose-priors", str(tmp_path / "cameras.json")]) == 3
    assert "found one of 7" in capsys.readouterr().err
    (tmp_path / "cameras.json").write_text('{"cameras": [{"file": "x.jpg", "R_w2c": 1}]}')
    assert main([*command, "--pose-priors", str(tmp_path / "cameras.json")]) == 3
    assert "camera 0" in capsys.readouterr().err
