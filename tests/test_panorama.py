"""Panoramas: rotations and their sigmas on synthetic rays, and pictures that are stitched from views of one sphere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import sfmapp
from schemas import check_schema
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_rays, project
from sfmapp.cli.main import main
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.headers import read_header
from sfmapp.panorama import compose, pairs, warp
from sfmapp.panorama.adjustment import Turned, TurnedFit, adjust_turns, refinable
from sfmapp.panorama.canvas import Canvas, View, choose_canvas, lenses_of
from sfmapp.panorama.level import level
from sfmapp.panorama.preview import Shown, find_gains
from sfmapp.panorama.report import TurnedPair
from sfmapp.panorama.seams import find_seams
from sfmapp.panorama.turning import _halves, _held_out, _Round
from sfmapp.panorama.turning_report import judge_pairs
from sfmapp.panorama.zooms import find_zooms, unzoomed
from sfmapp.scene.tracks import Tracks

Array = NDArray[np.float64]

LENS = Camera(CameraModel.RADIAL, 400, 300, np.array([330.0, 200.0, 150.0, -0.08, 0.01]))
UNKNOWN = Camera(CameraModel.RADIAL, 400, 300, np.array([480.0, 200.0, 150.0, 0.0, 0.0]))


def ring(num: int, pitch: float = 0.0) -> Array:
    """(num, 3, 3) cam_from_world all round, cameras level but for the pitch, in degrees."""
    yaw = np.radians(360.0 / num) * np.arange(num)
    tilt = rigid3.exp_so3([np.radians(pitch), 0.0, 0.0])
    return np.asarray(tilt @ rigid3.exp_so3(np.outer(-yaw, [0.0, 1.0, 0.0])), np.float64)


def scene(
    rotations: Array, num_rays: int, noise: float, seed: int, spread: bool = False
) -> tuple[Tracks, Array, Array]:
    """What cameras of LENS see of random directions, these, and how much noisier each keypoint is than others."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(num_rays, 3)) * [1.0, 0.4, 1.0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    track, image, pixels = [], [], []
    for k, rotation in enumerate(rotations):
        seen = rays @ rotation.T
        xy = project(LENS, seen)
        shown = (seen[:, 2] > 0.3) & (xy > 0).all(1) & (xy < [400, 300]).all(1)
        track.append(np.flatnonzero(shown))
        image.append(np.full(shown.sum(), k))
        pixels.append(xy[shown])
    ids, images, xy = np.concatenate(track), np.concatenate(image), np.concatenate(pixels)
    kept = np.isin(ids, np.flatnonzero(np.bincount(ids, minlength=num_rays) > 1))
    _, ids = np.unique(ids[kept], return_inverse=True)
    used = np.unique(np.concatenate(track)[kept])
    times = np.exp(rng.uniform(-1.4, 1.4, kept.sum())) if spread else np.ones(kept.sum())
    xy = xy[kept] + noise * times[:, None] * rng.normal(size=(kept.sum(), 2))
    tracks = Tracks.from_observations(ids, images[kept], xy, num_images=len(rotations))
    order = np.lexsort((images[kept], ids))
    assert (tracks.obs_xy == xy[order]).all()
    return tracks, rays[used], times[order]


def adjusted(rotations: Array, noise: float, seed: int, weigh: bool | None = None) -> TurnedFit:
    """``weigh``: keypoints differ in their noise, and the adjustment is told so or not."""
    tracks, rays, spread = scene(rotations, 1500, noise, seed, spread=weigh is not None)
    rng = np.random.default_rng(seed + 1000)
    start = Turned(
        [LENS.with_params([338.0, 200.0, 150.0, 0.0, 0.0])],
        rigid3.exp_so3(0.01 * rng.normal(size=(len(rotations), 3))) @ rotations, rays,
    )  # fmt: skip
    whose = np.zeros(len(rotations), np.int64)
    free = [refinable(UNKNOWN, distortion=2)]
    return adjust_turns(start, tracks, whose, free, [UNKNOWN], spread if weigh else None)


def errors(fit: TurnedFit, truth: Array) -> Array:
    """(I, 3) radians about the axes of each camera, in the gauge of the covariance."""
    away = rigid3.log_so3(fit.state.rotations @ truth.swapaxes(1, 2))
    common = np.einsum("nji,nj->ni", truth, away).mean(0)
    return np.asarray(away - truth @ common, np.float64)


def test_exact_rays_give_back_the_cameras() -> None:
    fit = adjusted(ring(10), 0.0, 0)
    assert np.abs(errors(fit, ring(10))).max() < 1e-6
    assert np.abs(fit.state.cameras[0].params - LENS.params).max() < 1e-3
    assert fit.correlation < 1.3


def test_sigmas_are_those_of_the_errors() -> None:
    """Of 20 rings with noise: 600 errors of rotations, 20 of each lens parameter; the bounds are three sigmas wide."""
    truth, rotation, focal, k1, whole = ring(10), [], [], [], []
    for seed in range(20):
        fit = adjusted(truth, 0.4, seed)
        assert fit.noise_px == pytest.approx(0.4, rel=0.08)
        rotation.append((errors(fit, truth) / np.radians(fit.rotation_sigma_deg)) ** 2)
        sigma = fit.sigmas(0)
        focal.append((np.log(fit.state.cameras[0].focal / LENS.focal) / sigma["log_focal"]) ** 2)
        k1.append(((fit.state.cameras[0].params[3] - LENS.params[3]) / sigma["k1"]) ** 2)
        covariance = fit.covariance[:30, :30]
        values, axes = np.linalg.eigh(covariance)
        told = values > 1e-9 * values.max()  # the rotations do not turn as a whole
        whole.append((axes.T @ errors(fit, truth).ravel())[told] ** 2 / values[told])
    assert 0.82 < np.mean(whole) < 1.18  # 540 of them, three sigmas
    # errors of neighbours in a ring go together: some three hundred of the six hundred are free
    assert 0.75 < np.mean(rotation) < 1.25
    assert 0.2 < np.mean(focal) < 2.1
    assert 0.2 < np.mean(k1) < 2.1


def test_noisy_keypoints_weigh_less() -> None:
    """Noise from a quarter to four times the middle: weights take a third of the errors; sigmas are right."""
    truth = ring(10)
    rms = []
    for weigh in (True, False):
        fits = [adjusted(truth, 0.3, seed, weigh) for seed in range(12)]
        away = [errors(fit, truth) for fit in fits]
        ratio = [each / np.radians(fit.rotation_sigma_deg) for each, fit in zip(away, fits, strict=True)]
        assert 0.7 < np.mean(np.square(ratio)) < 1.3
        rms.append(np.sqrt(np.mean(np.square(away))))
    assert rms[0] < 0.65 * rms[1]


def test_photographs_are_placed_by_their_lenses() -> None:
    """Against the projection of each pixel, on windows of canvases, one of them at a pole."""
    narrow = LENS.with_params([900.0, 200.0, 150.0, 0.0, 0.0])
    num_shown = 0
    for lens, projection, pitch in ((LENS, "spherical", 50.0), (LENS, "cylindrical", 5.0), (narrow, "planar", 0.0)):
        views = [View.of(lens, rotation) for rotation in ring(20, pitch)[:3]]
        canvas = choose_canvas(views, projection, None)  # type: ignore[arg-type]
        for at in np.linspace(0.0, 1.0, 4):
            columns, rows = (int(at * (size - 150)) + np.arange(150) + 0.5 for size in (canvas.width, canvas.height))
            axes = canvas.axes(columns, rows)
            rays = np.empty((150, 150, 3))
            rays[..., 0], rays[..., 1] = np.outer(axes.slant, axes.across), axes.down[:, None]
            rays[..., 2] = np.outer(axes.slant, axes.ahead)
            rays /= np.linalg.norm(rays, axis=2, keepdims=True)
            for k, view in enumerate(views):
                places, inside = np.empty((150, 150, 2), np.float32), np.empty((150, 150), np.bool_)
                warp.place_all(lenses_of(views), k, axes, places, inside)
                xy, shown = view.pixels(rays.reshape(-1, 3))
                xy, shown = xy.reshape(150, 150, 2), shown.reshape(150, 150)
                assert np.abs(places + 0.5 - xy)[inside & shown].max(initial=0.0) < 0.02
                assert (np.abs(np.minimum(xy, [400, 300] - xy).min(2) - 0.5)[inside != shown] < 0.02).all()
                num_shown += int(shown.sum())
    assert num_shown > 50_000


def test_each_pixel_is_of_the_nearest_label_that_shows_it() -> None:
    views = [View.of(LENS, rotation) for rotation in ring(6)]
    canvas = choose_canvas(views, "spherical", 400)
    small = canvas.scaled(0.25)
    label = np.random.default_rng(0).integers(-1, 6, (small.height, small.width)).astype(np.int16)
    label[:, : small.width // 3] = 2
    columns, rows = np.arange(canvas.width) - 20.5, np.arange(canvas.height) + 0.5
    x, y = (each * small.scale / canvas.scale - 0.5 for each in (columns, rows))
    owner = np.empty((len(rows), len(columns)), np.int16)
    axes = canvas.axes(columns, rows)
    warp.find_owners(lenses_of(views), axes, label, x, y, True, owner)
    share = np.zeros((6, *owner.shape), np.float32)
    around = np.concatenate([label[:, -9:], label, label[:, :9]], 1)
    place = np.meshgrid((x + 9).astype(np.float32), y.astype(np.float32))
    for k in range(6):
        share[k] = cv2.remap(
            (around == k).astype(np.float32), *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        places, inside = np.empty((*owner.shape, 2), np.float32), np.empty(owner.shape, np.bool_)
        warp.place_all(lenses_of(views), k, axes, places, inside)
        share[k][~inside] = 0.0
    best = np.where(share.max(0) > 0.0, share.argmax(0), -1)
    chosen = np.where(owner >= 0, np.take_along_axis(share, np.maximum(owner, 0)[None], 0)[0], 0.0)
    # OpenCV interpolates in steps of 1 / 32 of a pixel
    assert (chosen > share.max(0) - 0.07).mean() > 0.999
    assert (owner == best).mean() > 0.9


def test_a_wrong_pair_is_found_out_by_its_triangles_and_a_loop_is_shared() -> None:
    truth = ring(8)
    edges = [(i, (i + step) % 8) for i in range(8) for step in (1, 2)]
    edges = [(min(e), max(e)) for e in edges]
    rng = np.random.default_rng(0)
    turns = np.array([rigid3.exp_so3(0.004 * rng.normal(size=3)) @ truth[j] @ truth[i].T for i, j in edges])
    counts = np.full(len(edges), 80)
    turns[5] = rigid3.exp_so3([0.0, 0.9, 0.0]) @ turns[5]
    kept = pairs.consistent(edges, turns, counts)
    assert kept.tolist() == [k != 5 for k in range(len(edges))]
    found, agrees = pairs.average_rotations(8, np.array(edges)[kept], turns[kept], counts[kept])
    assert agrees.all()
    away = rigid3.log_so3(found @ found[0].T @ truth[0] @ truth.swapaxes(1, 2))
    assert np.abs(away).max() < 0.02


def test_half_of_the_matches_may_be_wrong() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(200, 3)) + np.array([0.0, 0.0, 4.0])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    turn = rigid3.exp_so3([0.1, -0.4, 0.05])
    b = a @ turn.T
    b[::2] = rng.normal(size=(100, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    found = pairs.fit_turn(a, b, 500.0, 2.0, (0, 1))
    assert rigid3.rotation_angle_deg(found.rotation @ turn.T) < 1e-3
    assert found.is_inlier[1::2].all()
    same = np.repeat(a[:1], 20, axis=0)
    assert np.isfinite(pairs.fit_turn(same, same, 500.0, 2.0, (0, 1)).rotation).all()
    assert not pairs.fit_turn(np.full((20, 3), np.nan), a[:20], 500.0, 2.0, (0, 1)).is_inlier.any()


def zoomed_pairs(zooms: Array, noise: float, seed: int) -> tuple[list[pairs.MatchedPixels], list[Array]]:
    """Neighbours in half a ring of cameras with these focal lengths over LENS's, and next but one: matches and maps."""
    rng = np.random.default_rng(seed)
    turns, found, maps = ring(2 * len(zooms)), [], []
    for i, j in [(i, i + step) for step in (1, 2) for i in range(len(zooms) - step)]:
        first, second = (np.diag([LENS.focal * zooms[k]] * 2 + [1.0]) for k in (i, j))
        exact = second @ turns[j] @ turns[i].T @ np.linalg.inv(first)
        xy = rng.uniform([-250.0, -150.0], [250.0, 150.0], (800, 2))
        there = np.column_stack([xy, np.ones(800)]) @ exact.T
        seen = there[:, :2] / there[:, 2:] + noise * rng.normal(size=(800, 2))
        shown = (there[:, 2] > 0.0) & (np.abs(seen) < [250.0, 150.0]).all(1)
        xy, seen = xy[shown], seen[shown]
        center = LENS.params[1:3]
        found.append(pairs.MatchedPixels((i, j), (0, 0), (xy + center, seen + center)))
        maps.append(cv2.findHomography(*found[-1].xy)[0])
    return found, maps


def test_zooms_are_told_by_the_maps_between_photographs() -> None:
    """Two and three focal lengths in any order, a wrong map among them, from a focal length that is a quarter off."""
    rng = np.random.default_rng(1)
    for steps in ([1.0, 1.2], [1.0, 2.0], [1.0, 1.03], [0.8, 1.0, 1.5]):
        which = np.concatenate([np.arange(len(steps)), rng.integers(0, len(steps), 13 - len(steps))])
        truth = np.array(steps)[which]
        matched, maps = zoomed_pairs(truth, 0.3, 2)
        maps[5] = maps[5] @ np.diag([1.7, 1.7, 1.0])
        found = find_zooms(LENS.with_focal(420.0), matched, maps, 2.0)
        assert found is not None
        assert found.images.tolist() == list(range(13))
        away = found.log_zoom - np.log(truth)
        assert np.abs(away - np.median(away)).max() < 0.01
        assert len(set(zip(found.group.tolist(), which.tolist(), strict=True))) == len(steps)
        pair, homography = unzoomed(matched[0], maps[0], found, LENS.params[1:3])
        ends = np.column_stack([pair.xy[0], np.ones(len(pair.xy[0]))]) @ homography.T
        assert np.abs(ends[:, :2] / ends[:, 2:] - pair.xy[1]).max() < 3.0


def test_one_zoom_stays_one() -> None:
    num_split = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert find_zooms(LENS, *zoomed_pairs(np.ones(10), 0.5, seed), 2.0) is None
        # a camera that moved makes zooms of any size, and hardly ever groups of them
        moved = zoomed_pairs(np.exp(0.05 * rng.normal(size=10)), 0.3, seed)
        num_split += find_zooms(LENS, *moved, 2.0) is not None
    assert num_split <= 2  # 2 % each are expected


@pytest.mark.parametrize("pitch", [0.0, 25.0])
def test_a_ring_is_levelled(pitch: float) -> None:
    tilted = ring(9, pitch) @ rigid3.exp_so3([0.2, 0.3, -0.4])
    levelled = level(tilted, [1] * 9)
    assert np.abs(levelled[:, 0, 1]).max() < 1e-9  # the x axes are horizontal
    assert (levelled[:, 1, 1] > 0.5).all()  # and down is down


def test_gains_undo_exposures() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(60.0, 110.0, (40, 200, 3)).astype(np.float32)
    factors = [1.0, 2.0, 0.8]
    shown = [
        Shown(60 * k, 0, base[:, 60 * k : 60 * k + 80] * factor, np.ones((40, 80), bool), np.ones((40, 80), np.float32))
        for k, factor in enumerate(factors)
    ]
    gains, apart = find_gains(shown)
    products = gains * np.array(factors)[:, None]
    assert np.abs(products / products[0] - 1.0).max() < 0.02
    assert apart.max() < 0.02


@pytest.mark.parametrize("start", [96, 236, 380])
def test_no_seam_cuts_what_moved(start: int) -> None:
    """Someone walks round a closed panorama: whole or not at all in it, also across its end, and where one photograph
    has but a half of them, and where nobody is are the middles of overlaps."""
    rng = np.random.default_rng(start)
    wide, num, reach = 400, 8, 75
    wall = cv2.blur(rng.uniform(40.0, 215.0, (100, wide, 3)).astype(np.float32), (5, 5))
    shown, where = [], np.zeros((num, 100, wide), bool)
    for k in range(num):
        left = (50 * k - 12) % wide
        columns = np.arange(left, left + reach) % wide
        at = start + 13 * k
        where[k, 30:80, np.arange(at, at + 20) % wide] = True
        picture = np.where(where[k][..., None], np.float32([250.0, 250.0, 0.0]), wall)
        inside, depth = np.zeros((100, wide), bool), np.zeros((100, wide), np.float32)
        inside[:, columns] = True
        depth[:, columns] = 1.0 - np.abs(np.linspace(-1.0, 1.0, reach))
        where[k] &= inside
        shown.append(Shown(0, 0, picture, inside, depth))
    canvas = Canvas("spherical", wide / (2.0 * np.pi), -wide / 2, -50.0, wide, 100, True)
    label = find_seams(shown, np.ones((num, 3)), canvas)
    assert (label >= 0).all()
    assert np.take_along_axis(np.stack([each.inside for each in shown]), label[None].astype(int), 0).all()
    beside = np.roll(label, -1, 1)
    rows, columns = np.nonzero(label != beside)
    # on both sides of a seam both photographs show the wall, as far as they show the place
    for k, other in ((label, beside), (beside, label)):
        for x in (columns, (columns + 1) % wide):
            a, b = k[rows, columns], other[rows, columns]
            both = np.array(
                [shown[p].inside[y, c] and shown[q].inside[y, c] for p, q, y, c in zip(a, b, rows, x, strict=True)]
            )
            assert not (where[a, rows, x] & ~where[b, rows, x] & both).any()
    # above them the seams stay in the middle of overlaps
    assert sorted(set(columns[rows < 5].tolist())) == [*range(50, wide, 50), wide - 1]


def test_strips_and_tiles_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """The margin is as wide as a pixel reaches: the same picture, whatever it is cut into."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (300, 400, 3)).astype(np.uint8) for _ in range(2)]
    views = [View.of(LENS, rotation) for rotation in ring(10)[:2]]
    canvas = choose_canvas(views, "cylindrical", None)
    label = np.zeros((canvas.height, canvas.width), np.int16)
    label[:, canvas.width // 2 :] = 0
    label[:, : canvas.width // 2] = 1
    plan = compose.Plan(canvas, lenses_of(views), np.ones((2, 3)), canvas, label)

    class Given:
        def __getitem__(self, k: int) -> NDArray[np.uint8]:
            return pictures[k]

    whole = compose._blend(plan, Given(), compose._Tile(0, 0, canvas.width, canvas.height))  # type: ignore[arg-type]
    part = compose._blend(plan, Given(), compose._Tile(128, 64, 96, 128))  # type: ignore[arg-type]
    difference = whole[0][64:192, 128:224].astype(int) - part[0].astype(int)
    assert np.abs(difference).max() <= 1
    assert (whole[1][64:192, 128:224] == part[1]).all()


def sphere() -> NDArray[np.uint8]:
    """(512, 1024, 3) an equirectangular texture."""
    rng = np.random.default_rng(7)
    total = np.zeros((512, 1024, 3))
    for size, weight in ((8, 1.0), (32, 0.8), (128, 0.7), (512, 0.4)):
        part = rng.normal(size=(size // 2, size, 3))
        part = np.concatenate([part, part[:, :1]], 1)
        total += weight * cv2.resize(part, (1024, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


def photograph(texture: NDArray[np.uint8], rotation: Array, focal: float) -> NDArray[np.uint8]:
    """(240, 320, 3) of a pinhole at the centre of the sphere."""
    y, x = np.mgrid[0:240, 0:320]
    rays = np.stack([(x - 159.5) / focal, (y - 119.5) / focal, np.ones_like(x)], -1) @ rotation
    u = (np.arctan2(rays[..., 0], rays[..., 2]) / np.pi + 1.0) * 512 - 0.5
    v = (np.arcsin(rays[..., 1] / np.linalg.norm(rays, axis=-1)) / np.pi + 0.5) * 512 - 0.5
    return cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


@pytest.fixture(scope="module")
def stitched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Array]:
    """Photographs, two of them behind the camera, one of something else, their panoramas, and the rotations."""
    folder = tmp_path_factory.mktemp("panorama")
    photos, texture = folder / "photos", sphere()
    photos.mkdir()
    rotations = ring(12)[[0, 1, 2, 3, 7, 8]]
    for k, rotation in enumerate(rotations):
        pixels = photograph(texture, rotation, 250.0)
        Image.fromarray(pixels).save(photos / f"{k}.png")
    noise = np.random.default_rng(1).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    Image.fromarray(noise).resize((320, 240)).save(photos / "stray.png")
    assert main(["panorama", str(photos), "-o", str(folder / "out"), "--projection", "spherical", "-q"]) == 0
    return photos, folder / "out", rotations[:4]


def test_photographs_become_a_panorama(stitched: tuple[Path, Path, Array]) -> None:
    photos, out, truth = stitched
    report = json.loads((out / "report.json").read_text())
    check_schema("panorama", report)
    left_out = {one["name"]: one["reason"] for one in report["turning"]["left_out"]}
    assert list(left_out) == ["4.png", "5.png", "stray.png"]
    assert "belongs to another panorama, of 2 photographs" in left_out["4.png"]
    focal = report["turning"]["cameras"][0]
    assert focal["focal_px"] == pytest.approx(250.0, rel=0.005)
    model, _ = read_model(out / "sparse" / "0")
    assert np.abs(model.cam_from_world[:, 4:]).max() == 0.0
    found = rigid3.rotation_matrix(model.cam_from_world)
    away = found @ found[0].T @ truth[0] @ truth.swapaxes(1, 2)
    assert rigid3.rotation_angle_deg(away).max() < 0.1
    entries = json.loads((out / "rotations.json").read_text())["images"]
    assert np.allclose(entries[1]["cam_from_world"], model.cam_from_world[1, :4], atol=1e-9)
    assert "<img" in (out / "report.html").read_text()
    # the panorama is the texture: the same rays have the same colours
    data = (out / "panorama.jpg").read_bytes()
    tags = {name: int(value) for name, value in re.findall(rb'GPano:(\w+)="(\d+)"', data)}
    header = read_header(data)
    assert tags[b"CroppedAreaImageWidthPixels"] == header.width
    assert tags[b"FullPanoWidthPixels"] == pytest.approx(2 * np.pi * focal["focal_px"], abs=1.0)
    picture = np.asarray(Image.open(out / "panorama.jpg"), np.float64)
    view = rigid3.rotation_matrix(model.cam_from_world[1, :4])
    ray = view.T @ np.array([0.05, 0.02, 1.0])
    x = np.arctan2(ray[0], ray[2]) * focal["focal_px"] + 0.5 * tags[b"FullPanoWidthPixels"]
    y = np.arcsin(ray[1] / np.linalg.norm(ray)) * focal["focal_px"] + 0.5 * tags[b"FullPanoHeightPixels"]
    at = int(x - tags[b"CroppedAreaLeftPixels"]), int(y - tags[b"CroppedAreaTopPixels"])
    source = np.asarray(Image.open(photos / "1.png"), np.float64)
    there = source[120 + 4 : 120 + 7, 160 + 11 : 160 + 14].mean((0, 1))
    assert np.abs(picture[at[1] - 1 : at[1] + 2, at[0] - 1 : at[0] + 2].mean((0, 1)) - there).max() < 12.0


def test_photographs_that_overlap_none_of_them_become_another_panorama(stitched: tuple[Path, Path, Array]) -> None:
    _, out, _ = stitched
    (other,) = json.loads((out / "report.json").read_text())["others"]
    assert [one["name"] for one in other["turning"]["images"]] == ["4.png", "5.png"]
    assert other["turning"]["left_out"] == []
    picture = Image.open(out / "panorama-2.jpg")
    assert other["picture"]["file"] == "panorama-2.jpg"
    assert picture.size == (other["picture"]["width"], other["picture"]["height"])
    model, _ = read_model(out / "sparse" / "1")
    entries = json.loads((out / "rotations.json").read_text())["others"][0]["images"]
    assert np.allclose([one["cam_from_world"] for one in entries], model.cam_from_world[:, :4], atol=1e-9)
    turn = rigid3.rotation_matrix(model.cam_from_world)
    assert rigid3.rotation_angle_deg(turn[1] @ turn[0].T) == pytest.approx(30.0, abs=0.5)
    assert (out / "report.html").read_text().count("<img") == 2


def test_photographs_of_two_zooms_have_a_camera_each(tmp_path: Path) -> None:
    """Of one size, without EXIF; the last is the only one of its zoom."""
    photos, texture, truth = tmp_path / "photos", sphere(), ring(14)[:6]
    photos.mkdir()
    focals = [250.0, 250.0, 350.0, 250.0, 350.0, 250.0]
    for k, (rotation, focal) in enumerate(zip(truth, focals, strict=True)):
        Image.fromarray(photograph(texture, rotation, focal)).save(photos / f"{k}.png")
    result = sfmapp.stitch_panorama(photos, tmp_path / "out", max_size=600)
    turning = result.report.turning
    assert turning is not None
    assert turning.num_turned == 6
    assert [camera.num_images for camera in turning.cameras] == [4, 2]
    for image, focal in zip(turning.images, focals, strict=True):
        assert turning.cameras[image.camera_idx].focal_px == pytest.approx(focal, rel=0.003)
    found = rigid3.rotation_matrix(np.array([image.rotation for image in turning.images]))
    away = found @ found[0].T @ truth[0] @ truth.swapaxes(1, 2)
    assert rigid3.rotation_angle_deg(away).max() < 0.1
    assert any("2 photographs" in each["message"] for each in result.report.decisions)
    model, _ = read_model(tmp_path / "out" / "sparse" / "0")
    assert len(model.cameras) == 2


def test_a_lens_without_inverse_predicts_nothing() -> None:
    """Of two photographs that hardly differ: a fit to one half of the rays bends the lens so that others have none."""
    tracks, rays, spread = scene(ring(40)[:2], 400, 0.3, 0)
    bent = [LENS.with_params([330.0, 200.0, 150.0, -2.0, 0.0])]
    state = Turned(bent, ring(40)[:2], rays)
    fit = TurnedFit(state, np.zeros((tracks.num_observations, 2)), 0.3, ((),), np.zeros((6, 6)), 1.0, 0.0)
    whose, none = np.zeros(2, np.int64), np.zeros(0, np.int64)
    found = _Round(np.arange(2), [], none, tracks, whose, fit)
    halves = _halves(tracks, spread)
    assert _held_out(state, halves, 0, found, [()], bent) == 400.0


def moved_pair(noise: float, by: float, spread: float, seed: int) -> tuple[TurnedPair, float]:
    """What is said of a pair with that noise, pixels, in a panorama with noise of 0.1, and the parallax that it has.

    The second camera has moved sideways, so that a wall, inclined by depths from one to two, moves by ``by`` pixels;
    points stand before it by a share of their depth that goes up to ``spread``.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform([20.0, 20.0], [380.0, 280.0], (200, 2))
    rays = pixels_to_rays(LENS, xy)
    inverse = (0.5 + 0.5 * xy[:, 0] / 400.0) * rng.uniform(1.0, 1.0 + spread, 200)
    turn = rigid3.exp_so3([0.02, 0.05, 0.0])
    # what they have in common is a turn to the panorama
    moved = rays - np.outer(inverse - inverse.mean(), [by / LENS.focal, 0.0, 0.0])
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    parallax = LENS.focal * float(np.median(np.linalg.norm(moved - rays, axis=1)))
    seen = project(LENS, moved @ turn.T) + noise * rng.normal(size=(200, 2))
    state = Turned([LENS], np.stack([np.eye(3), turn]), rays)
    fit = TurnedFit(state, np.zeros((400, 2)), 0.1, ((),), np.zeros((6, 6)), 1.0, 0.0)
    pair = pairs.MatchedPixels((0, 1), (0, 0), (xy, seen))
    return judge_pairs([pair], [50.0], np.arange(2), ["a", "b"], fit, 0)[0], parallax


def test_parallax_is_held_to_the_noise_of_its_pair() -> None:
    """A blurred photograph has five times the noise of the others and no parallax; what has moved is told, where
    neighbours are equally far and where they are not."""
    for seed in range(20):
        blurred, _ = moved_pair(0.5, 0.0, 0.0, seed)
        assert blurred.median_px > 2.0 * 0.1 * 2.0 * np.sqrt(np.log(2.0))  # twice what noise of 0.1 makes of it
        assert blurred.parallax_px == 0.0
        for noise, spread in ((0.1, 0.0), (0.5, 0.0), (0.1, 3.0), (0.5, 3.0)):
            moved, parallax = moved_pair(noise, 40.0, spread, seed)
            assert moved.parallax_px == pytest.approx(parallax, rel=0.15)


def test_sharp_frames_of_a_video_become_a_panorama(tmp_path: Path) -> None:
    """Turned by 90 degrees, there and a little back, two of three frames blurred."""
    texture, path = sphere(), tmp_path / "turn.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (320, 240))
    for k, yaw in enumerate(np.radians([*np.linspace(0.0, 90.0, 46), *np.linspace(88.0, 80.0, 5)])):
        pixels = photograph(texture, rigid3.exp_so3([0.0, -yaw, 0.0]), 250.0)
        video.write(pixels if k % 3 == 1 else cv2.GaussianBlur(pixels, (0, 0), 2.0))
    video.release()
    result = sfmapp.stitch_panorama(path, tmp_path / "out", max_size=600)
    assert result.picture.is_file()
    turning = result.report.turning
    assert turning is not None
    assert turning.num_turned == turning.num_images
    assert 6 <= turning.num_images <= 12
    assert all(int(one.name[:6]) % 3 == 1 for one in turning.images)
    assert turning.cameras[0].focal_px == pytest.approx(250.0, rel=0.005)
    made = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out" / "frames").iterdir()}
    assert sfmapp.stitch_panorama(path, tmp_path / "out", max_size=600).report.run.is_up_to_date
    assert made == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out" / "frames").iterdir()}
    (tmp_path / "b.mp4").write_bytes(b"none")
    with pytest.raises(sfmapp.InputError, match=r"b\.mp4: expected a video"):
        sfmapp.stitch_panorama(tmp_path / "b.mp4", tmp_path / "b")


def test_the_same_command_has_nothing_to_do(
    stitched: tuple[Path, Path, Array], capsys: pytest.CaptureFixture[str]
) -> None:
    photos, out, _ = stitched
    before = (out / "panorama.jpg").stat().st_mtime_ns
    assert main(["panorama", str(photos), "-o", str(out), "--projection", "spherical"]) == 0
    assert "up to date" in capsys.readouterr().out
    assert (out / "panorama.jpg").stat().st_mtime_ns == before


def test_copies_of_one_picture_tell_no_focal_length(tmp_path: Path, stitched: tuple[Path, Path, Array]) -> None:
    photos, _, _ = stitched
    copies = tmp_path / "copies"
    copies.mkdir()
    for k in range(2):
        (copies / f"{k}.png").write_bytes((photos / "0.png").read_bytes())
    assert main(["panorama", str(copies), "-o", str(tmp_path / "out"), "-q"]) == 0
    camera = json.loads((tmp_path / "out" / "report.json").read_text())["turning"]["cameras"][0]
    assert not camera["is_told"]
    assert camera["focal_px"] == pytest.approx(camera["prior_focal_px"], rel=0.05)


def test_what_is_no_panorama_is_refused(tmp_path: Path, stitched: tuple[Path, Path, Array]) -> None:
    photos, _, _ = stitched
    assert main(["panorama", str(tmp_path / "nowhere"), "-o", str(tmp_path / "a"), "-q"]) == 3
    assert main(["panorama", str(photos), "-o", str(tmp_path / "b"), "--picture", "a.gif", "-q"]) == 2
    assert main(["panorama", str(photos / "0.png"), "-o", str(tmp_path / "c"), "-q"]) in (3, 4)
    flat = tmp_path / "flat"
    flat.mkdir()
    texture = sphere()
    for k in range(3):  # a wall seen from three places, before a nearer one that hides half of it
        far, near = texture[100:340, 100 + 20 * k : 420 + 20 * k], texture[200:440, 500 + 60 * k : 820 + 60 * k]
        stripes = (np.arange(320) // 40 % 2 == 0)[None, :, None]
        Image.fromarray(np.where(stripes, far, near)).save(flat / f"{k}.png")
    out = tmp_path / "d"
    assert main(["panorama", str(flat), "-o", str(out), "-q"]) == 4
    report = json.loads((out / "report.json").read_text())
    check_schema("panorama", report)
    assert "reconstruct" in report["outcome"]["advice"]
