"""Folders, patterns and lists of photographs, shared cameras, and files that mean harm."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sfmapp.camera.camera import CameraModel
from sfmapp.errors import InputError, InterruptedRunError, UsageError
from sfmapp.events import Event, Events
from sfmapp.images.folder import ImageOptions, ImageSet, load_images
from sfmapp.images.pixels import read_picture
from sfmapp.reporting import plain
from sfmapp.sequences.files import has_images, list_images

DATA = Path(os.environ.get("SFMAPP_DATA", Path(__file__).parents[2] / "shared" / "data"))


def save(path: Path, seed: int = 0, width: int = 48, height: int = 32, **kwargs: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng([seed, width, height]).integers(0, 256, (height, width, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, **kwargs)
    return path


def exif_of(make: str = "Canon", model: str = "Canon EOS 60D", orientation: int = 1, **photo: Any) -> Image.Exif:
    tags = {"focal_mm": 37386, "focal_35mm": 41989, "serial": 42033, "lens": 42036}
    exif = Image.Exif()
    exif.update({271: make, 272: model, 274: orientation})
    exif.get_ifd(34665).update({tags[name]: value for name, value in photo.items()})
    return exif


def load(source: Path | str, **options: Any) -> tuple[ImageSet, dict[str, Any], list[Event]]:
    log: list[Event] = []
    image_set, report = load_images(source, ImageOptions(**options), Events(log.append))
    json.dumps(plain(report), allow_nan=False)
    return image_set, report, log


def names(image_set: ImageSet) -> list[str]:
    return [image.name for image in image_set.images]


def sharing(image_set: ImageSet) -> list[int]:
    return [image.camera_idx for image in image_set.images]


def skip_reason(tmp_path: Path, file_name: str, data: bytes) -> str:
    """Why a file with these bytes is skipped; its good neighbour must stay, and both must be told."""
    save(tmp_path / "good.png")
    (tmp_path / file_name).write_bytes(data)
    image_set, report, log = load(tmp_path)
    assert names(image_set) == ["good.png"]
    ((name, reason),) = image_set.skipped
    assert name == file_name
    assert report["skipped"] == [{"name": name, "reason": reason}]
    assert [e.message for e in log if e.kind == "warned"] == [f"skipped {name}: {reason}"]
    return reason


# --------------------------------------------------------------------------------------------------------- sources


def test_folder_is_searched_in_natural_order(tmp_path: Path) -> None:
    wanted = ["a/img2.jpg", "a/img10.JPEG", "B/9.tif", "b.d/x.webp", "img1.png", "img02.bmp", "Img2.ppm", "img10.pgm"]
    for i, name in enumerate(reversed(wanted)):
        save(tmp_path / name, seed=i)
    for hidden in (".thumb.jpg", ".cache/a.jpg", "__MACOSX/a.jpg", "a/@eaDir/img2.jpg", "notes.txt", "a/README"):
        (tmp_path / hidden).parent.mkdir(exist_ok=True)
        (tmp_path / hidden).write_bytes(b"nothing")
    image_set, report, log = load(tmp_path)
    assert names(image_set) == wanted
    assert image_set.skipped == ()
    assert (report["num_found"], report["num_used"]) == (8, 8)
    assert [e.message for e in log if e.kind == "warned"] == []
    for image in image_set.images:
        assert image.path.is_absolute()
        assert (image.width, image.height) == read_picture(image).gray.shape[::-1] == (48, 32)


def workspace(folder: Path, version: int = 1) -> Path:
    """What a run leaves behind, as far as it is told by, with pictures in it."""
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"format": f"sfmapp workspace {version}", "stages": {}}, indent=1))
    save(folder / "dense/maps/a.jpg.depth.png", seed=3)
    save(folder / "picture.png", seed=4)
    return folder


@pytest.mark.parametrize("version", [1, 7])
def test_results_inside_the_folder_are_no_photographs(tmp_path: Path, version: int) -> None:
    """Of any command and version, at any depth, and however the folder is named; they are told, not warned of."""
    save(tmp_path / "photos/a.jpg")
    workspace(tmp_path / "photos/out", version)
    workspace(tmp_path / "photos/b/c/runs/second", version)
    save(tmp_path / "photos/b/c/runs/1.jpg", seed=9)
    os.symlink(tmp_path / "photos/out", tmp_path / "photos/latest")
    # another program's run.json is nobody's business
    save(tmp_path / "photos/wandb/2.jpg", seed=10)
    (tmp_path / "photos/wandb/run.json").write_text('{"project": "sfmapp workspace"}')
    wanted = ["a.jpg", "b/c/runs/1.jpg", "wandb/2.jpg"]
    image_set, report, log = load(tmp_path / "photos")
    assert names(image_set) == wanted
    assert sorted(report["results_passed_over"]) == ["b/c/runs/second/", "latest/", "out/"]
    assert [e.message for e in log if e.kind == "warned"] == []
    assert any("results of sfmapp" in e.message for e in log if e.kind == "decided")
    assert "results of sfmapp in" in next(e.message for e in log if e.kind == "finished")
    assert names(load(tmp_path / "photos/**/*.*g")[0]) == wanted
    # what is named is used
    assert names(load(tmp_path / "photos/out/dense/maps")[0]) == ["a.jpg.depth.png"]
    with pytest.raises(InputError, match="matches only results of sfmapp, in dense/"):
        load(str(tmp_path / "photos/out/**/*.depth.png"))
    (tmp_path / "list.txt").write_text("photos/out/picture.png\nphotos/a.jpg\n")
    assert names(load(tmp_path / "list.txt")[0]) == ["a.jpg", "out/picture.png"]


def test_a_workspace_as_the_source_keeps_its_results_to_itself(tmp_path: Path) -> None:
    workspace(tmp_path / "out")
    assert names(load(tmp_path / "out")[0]) == ["picture.png"]
    (tmp_path / "out/picture.png").unlink()
    _, _, log = load(tmp_path / "out")
    assert any("other than in dense/, which holds results of sfmapp" in e.message for e in log if e.kind == "warned")


def test_copies_that_other_programs_made_are_left_out_and_told(tmp_path: Path) -> None:
    for i, name in enumerate(("images/a.jpg", "images_2/a.jpg", "images_4/a.jpg", "dense/images/a.jpg")):
        save(tmp_path / name, seed=i)
    (tmp_path / "transforms.json").write_text("{}")
    (tmp_path / "dense/stereo").mkdir()
    (tmp_path / "dense/stereo/fusion.cfg").write_text("a.jpg\n")
    image_set, _, log = load(tmp_path)
    assert names(image_set) == ["images/a.jpg"]
    assert [name for name, _ in image_set.skipped] == ["dense/", "images_2/", "images_4/"]
    assert all("name it as the source" in reason for _, reason in image_set.skipped)
    assert sum(e.kind == "warned" for e in log) == 2
    for name in ("images_4", "dense"):
        assert len(load(tmp_path / name)[0].images) == 1
    (tmp_path / "transforms.json").unlink()
    assert len(load(tmp_path)[0].images) == 3  # by their names alone they may be anything


@pytest.mark.parametrize(
    ("copy", "original", "mark"),
    [
        ("images/a.jpg", "input/a.jpg", "stereo/patch-match.cfg"),
        ("undistorted/images/a.jpg", "images/a.jpg", "reconstruction.json"),
        ("odm_orthophoto/odm_orthophoto.tif", "images/a.jpg", "opensfm/config.yaml"),
    ],
)
def test_projects_of_other_programs(tmp_path: Path, copy: str, original: str, mark: str) -> None:
    save(tmp_path / copy)
    save(tmp_path / original, seed=1)
    assert sorted(names(load(tmp_path)[0])) == sorted([copy, original])
    (tmp_path / mark).parent.mkdir(exist_ok=True)
    (tmp_path / mark).write_text("{}")
    image_set, _, _ = load(tmp_path)
    assert names(image_set) == [original]
    assert [name for name, _ in image_set.skipped] == [copy.split("/")[0] + "/"]


def test_endings_in_any_case_and_files_without_one(tmp_path: Path) -> None:
    wanted = ["1.JPE", "2.jfif", "3.Jif", "4.DIB", "5.PNM", "6.Tiff", "7", "IMG.0008", "shoot/DSC_9"]
    formats = ("JPEG", "JPEG", "JPEG", "BMP", "PPM", "TIFF", "JPEG", "PNG", "WEBP")
    for i, (name, kind) in enumerate(zip(wanted, formats, strict=True)):
        save(tmp_path / name, seed=i, format=kind)
    for name, data in (("LICENSE", b"MIT"), ("empty", b""), ("notes.md", b"# BM"), ("BMW", b"BMW is no bitmap")):
        (tmp_path / name).write_bytes(data)
    os.mkfifo(tmp_path / "pipe")
    image_set, _, log = load(tmp_path)
    assert names(image_set) == wanted
    assert image_set.skipped == ()
    assert [e.message for e in log if e.kind == "warned"] == []
    for image in image_set.images:
        assert read_picture(image).gray.shape == (32, 48)


def test_frames_without_an_ending(tmp_path: Path) -> None:
    for i, name in enumerate(("1403636579763555584", "1403636579813555456", "b.PNG", "1305031102.175304")):
        save(tmp_path / name, seed=i, format="PNG")
    (tmp_path / "README").write_text("frames")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/README").write_text("none")
    assert [path.name for path in list_images(tmp_path)] == ["1403636579763555584", "1403636579813555456", "b.PNG"]
    assert has_images(tmp_path)
    assert not has_images(tmp_path / "empty")


def test_pictures_under_other_endings_are_told(tmp_path: Path) -> None:
    for i, name in enumerate(("a.jpg", "a.jpg_original", "a.thm", "b.dat")):
        save(tmp_path / name, seed=i, format="PNG" if name == "b.dat" else "JPEG")
    image_set, _, log = load(tmp_path)
    assert names(image_set) == ["a.jpg"]
    assert dict(image_set.skipped)["b.dat"] == "holds a PNG picture but ends in .dat: rename it if it is a photograph"
    assert [name for name, _ in image_set.skipped] == ["a.jpg_original", "a.thm", "b.dat"]
    assert sum(e.kind == "warned" for e in log) == 3


def test_a_pattern_says_what_it_misses_by_the_case_of_letters(tmp_path: Path) -> None:
    for i, name in enumerate(("a.jpg", "B.JPG", "c.Jpg", "d.png")):
        save(tmp_path / name, seed=i, format="PNG")
    image_set, _, _ = load(str(tmp_path / "*.jpg"))
    assert names(image_set) == ["a.jpg"]
    assert [name for name, _ in image_set.skipped] == ["B.JPG", "c.Jpg"]
    assert load(str(tmp_path / "*.[jJ][pP][gG]"))[0].skipped == ()


def test_pattern_names_are_relative_to_its_fixed_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("p/a/1.jpg", "p/b/2.jpg", "p/b/2.png", "p/b/3.txt"):
        save(tmp_path / name, format="PNG")
    (tmp_path / "p/b/folder.jpg").mkdir()
    image_set, _, _ = load(str(tmp_path / "p/*/*.jpg"))
    assert names(image_set) == ["a/1.jpg", "b/2.jpg"]
    assert image_set.skipped == (("b/folder.jpg", "a folder, not a file"),)
    monkeypatch.chdir(tmp_path / "p")
    assert names(load("**/[ab]/*")[0]) == ["a/1.jpg", "b/2.jpg", "b/2.png"]


def test_folder_with_brackets_in_its_name_is_a_folder(tmp_path: Path) -> None:
    save(tmp_path / "shoot [1]/a.jpg")
    assert names(load(tmp_path / "shoot [1]")[0]) == ["a.jpg"]


def test_list_file(tmp_path: Path) -> None:
    for name in ("photos/a/1.jpg", "photos/b 2.jpg", "elsewhere/c.jpg"):
        save(tmp_path / name)
    lines = [
        "\ufeff# the good ones", "photos/b 2.jpg", "", "  photos/a/1.jpg  ", f"{tmp_path}/elsewhere/c.jpg",
        "photos/../photos/a/1.jpg", "photos/none.jpg", "https://example.org/d.jpg", "nul\0.jpg", "photos/a",
    ]  # fmt: skip
    (tmp_path / "list.txt").write_text("\r\n".join(lines), "utf-8")
    image_set, report, _ = load(tmp_path / "list.txt")
    assert names(image_set) == ["elsewhere/c.jpg", "photos/a/1.jpg", "photos/b 2.jpg"]
    assert report["root"] == str(tmp_path)
    assert dict(image_set.skipped) == {
        "photos/none.jpg": "no such file",
        "photos/a": "a folder, not a file",
        "photos/../photos/a/1.jpg": "listed twice (line 6 of the list)",
        "https://example.org/d.jpg": "line 8 of the list is not a path",
        "nul\\x00.jpg": "line 9 of the list is not a path",
    }
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/list.txt").write_text("../photos/a/1.jpg\n../photos/b 2.jpg\n")
    assert names(load(tmp_path / "sub/list.txt")[0]) == ["a/1.jpg", "b 2.jpg"]  # never with ..


@pytest.mark.parametrize("source", ["nothing", "nothing/*.jpg", "a.jpg", "", "binary.txt"])
def test_sources_that_are_none_end_with_advice(tmp_path: Path, source: str) -> None:
    save(tmp_path / "a.jpg")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError) as caught:
        load(str(tmp_path / source) if source else "")
    assert caught.value.advice


@pytest.mark.parametrize("list_file", [False, True])
def test_no_image_is_an_empty_set_and_a_warning(tmp_path: Path, list_file: bool) -> None:
    (tmp_path / "notes.txt").write_text("# nothing\n")
    image_set, report, log = load(tmp_path / "notes.txt" if list_file else tmp_path)
    assert (image_set.images, image_set.cameras, report["num_used"]) == ((), (), 0)
    assert any(e.kind == "warned" and "no usable image" in e.message for e in log)


def test_same_bytes_for_any_number_of_threads(tmp_path: Path) -> None:
    for i in range(20):
        save(tmp_path / f"{i % 3}/{i}.png", seed=i)
    (tmp_path / "bad.jpg").write_bytes(b"bad")
    results = [load_images(tmp_path, ImageOptions(), Events(), threads=threads) for threads in (1, 2, 7)]
    reports = [{key: value for key, value in report.items() if key != "wall_s"} for _, report in results]
    assert reports[0] == reports[1] == reports[2]
    assert results[0][0].images == results[1][0].images == results[2][0].images


def test_duplicates_stay_and_are_told(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        save(tmp_path / name, seed=1)
    save(tmp_path / "c.png", seed=2)
    image_set, report, log = load(tmp_path)
    assert names(image_set) == ["a.png", "b.png", "c.png"]
    assert report["duplicates"] == [["a.png", "b.png"]]
    assert next(e.message for e in log if e.kind == "warned").startswith("a.png, b.png are the same file")
    a, b, c = image_set.images
    assert a.digest == b.digest != c.digest


def test_a_stop_is_obeyed(tmp_path: Path) -> None:
    for i in range(5):
        save(tmp_path / f"{i}.png", seed=i)
    events = Events()
    events.subscribe(lambda event: events.cancel() if event.done == 2 else None)
    with pytest.raises(InterruptedRunError):
        load_images(tmp_path, ImageOptions(), events)


# --------------------------------------------------------------------------------------------------------- cameras


def test_exif_cameras_are_told_apart_by_all_that_matters(tmp_path: Path) -> None:
    save(tmp_path / "a1.jpg", exif=exif_of(focal_mm=20.0))
    save(tmp_path / "a2.jpg", seed=1, exif=exif_of(focal_mm=20.0))
    save(tmp_path / "b.jpg", exif=exif_of(focal_mm=35.0))
    save(tmp_path / "c.jpg", width=64, exif=exif_of(focal_mm=20.0))
    save(tmp_path / "d.jpg", exif=exif_of(model="Canon EOS 70D", focal_mm=20.0))
    save(tmp_path / "e.jpg", exif=exif_of(focal_mm=20.0, serial="77"))
    # how it was held is no matter of the camera; a mirror moves its centre to the other side
    save(tmp_path / "f.jpg", exif=exif_of(focal_mm=20.0, orientation=6))
    save(tmp_path / "g.jpg", exif=exif_of(focal_mm=20.0, orientation=2))
    save(tmp_path / "sub/a3.jpg", seed=2, exif=exif_of(focal_mm=20.0))
    image_set, report, _ = load(tmp_path)
    assert sharing(image_set) == [0, 0, 1, 2, 3, 4, 0, 5, 0]
    first = image_set.cameras[0]
    assert (first.width, first.height, first.model) == (48, 32, CameraModel.SIMPLE_RADIAL)
    assert first.params.tolist() == pytest.approx([20.0 / 22.3 * 48, 24.0, 16.0, 0.0])
    assert (image_set.cameras[5].width, image_set.cameras[5].height) == (48, 32)
    entry = report["cameras"][0]
    assert (entry["num_images"], entry["focal_source"], entry["camera"]) == (4, "exif_sensor", "Canon EOS 60D")
    assert "sensor 22.3 mm" in entry["focal_reason"]


def test_exif_focal_lengths_that_differ_by_rounding_are_one_camera(tmp_path: Path) -> None:
    for i, focal_mm in enumerate((20.0, 20.0001, 19.99995, 20.1, 20.2)):
        save(tmp_path / f"{i}.jpg", seed=i, exif=exif_of(focal_mm=focal_mm))
    assert sharing(load(tmp_path)[0]) == [0, 0, 0, 1, 2]


def test_frames_without_exif_share_a_camera(tmp_path: Path) -> None:
    for i in range(12):
        save(tmp_path / f"frame_{i:04}.jpg", seed=i)
    image_set, report, _ = load(tmp_path)
    assert sharing(image_set) == [0] * 12
    assert image_set.cameras[0].focal_source == "default"
    assert image_set.cameras[0].params[0] == pytest.approx(1.2 * 48)
    assert image_set.cameras[0].focal_sigma == pytest.approx(0.6 * 48)
    assert "no EXIF" in report["cameras"][0]["sharing"]


def test_two_pictures_of_one_size_share_a_camera(tmp_path: Path) -> None:
    save(tmp_path / "left.png")
    save(tmp_path / "right.png", seed=1)
    assert sharing(load(tmp_path)[0]) == [0, 0]


def test_portrait_and_landscape_frames_are_one_series(tmp_path: Path) -> None:
    for i in range(10):
        save(tmp_path / f"{i}.jpg", seed=i, width=48 if i % 2 else 32, height=32 if i % 2 else 48)
    assert sharing(load(tmp_path)[0]) == [0, 1] * 5


def test_pictures_from_many_people_have_a_camera_each(tmp_path: Path) -> None:
    """As collected from the web: no EXIF, numbers for names, half of them of one size."""
    for i in range(20):
        save(tmp_path / f"{i * 7919 % 1000}_{i}.jpg", seed=i, width=48 + 2 * max(0, i - 10))
    image_set, report, _ = load(tmp_path)
    assert sorted(sharing(image_set)) == list(range(20))
    assert "on its own" in report["cameras"][0]["sharing"]


def test_two_videos_in_one_folder_are_two_cameras(tmp_path: Path) -> None:
    for i in range(8):
        save(tmp_path / f"left_{i}.jpg", seed=i)
        save(tmp_path / f"right_{i}.jpg", seed=i + 10, width=64)
        save(tmp_path / f"again_{i}.jpg", seed=i + 20)
    assert sharing(load(tmp_path)[0]) == [0] * 8 + [1] * 8 + [2] * 8


def test_folders_are_series_of_their_own_and_a_stray_stands_alone(tmp_path: Path) -> None:
    for i in range(12):
        save(tmp_path / f"a/{i}.jpg", seed=i)
        save(tmp_path / f"b/{i}.jpg", seed=i + 20)
    save(tmp_path / "b/12.jpg", width=64)
    assert sharing(load(tmp_path)[0]) == [0] * 12 + [1] * 12 + [2]


def test_options_for_sharing(tmp_path: Path) -> None:
    for i, folder in enumerate(("a", "a", "b", "b")):
        save(tmp_path / f"{folder}/{i}.jpg", seed=i, exif=exif_of(focal_mm=20.0 + i))
    assert sharing(load(tmp_path)[0]) == [0, 1, 2, 3]
    assert sharing(load(tmp_path, camera_sharing="all")[0]) == [0, 0, 0, 0]
    assert sharing(load(tmp_path, camera_sharing="per_folder")[0]) == [0, 0, 1, 1]
    assert sharing(load(tmp_path, camera_sharing="per_image")[0]) == [0, 1, 2, 3]
    merged = load(tmp_path, camera_sharing="all")[0].cameras[0]
    focals = np.array([20.0, 21.0, 22.0, 23.0]) / 22.3 * 48
    assert merged.focal == pytest.approx(np.median(focals))
    assert merged.focal_sigma is not None
    assert merged.focal_sigma > focals.std()


def test_what_the_user_says_counts_most(tmp_path: Path) -> None:
    for i in range(2):
        save(tmp_path / f"{i}.jpg", seed=i, exif=exif_of(focal_35mm=28, focal_mm=18.0 + i))
    by_focal = load(tmp_path, focal_px=50.0, camera_model="OPENCV")[0]
    assert [camera.focal_source for camera in by_focal.cameras] == ["user", "user"]
    assert by_focal.cameras[0].params.tolist() == [50.0, 50.0, 24.0, 16.0, 0.0, 0.0, 0.0, 0.0]
    by_params = load(tmp_path, camera_params=(50.0, 24.5, 15.5, 0.01), fix_intrinsics=True)[0]
    (camera,) = by_params.cameras
    assert camera.params.tolist() == [50.0, 24.5, 15.5, 0.01]
    assert camera.is_fixed
    assert camera.focal_sigma == pytest.approx(0.5)
    save(tmp_path / "2.jpg", width=64)
    with pytest.raises(UsageError, match="48x32, 64x32"):
        load(tmp_path, camera_params=(50.0, 24.5, 15.5, 0.01))


def test_absurd_exif_is_told_once_for_all(tmp_path: Path) -> None:
    for i in range(20):
        save(tmp_path / f"{i}.jpg", seed=i, exif=exif_of(focal_35mm=0, focal_mm=-4.0))
    image_set, report, log = load(tmp_path)
    told = [e.message for e in log if e.kind == "warned"]
    assert len(told) == 2
    assert told[0].startswith("0.jpg, 1.jpg, 2.jpg")
    assert told[0].endswith("and 12 more: EXIF FocalLength is -4")
    assert len(report["problems"]) == 40
    assert {camera.focal_source for camera in image_set.cameras} == {"default"}


# ------------------------------------------------------------------------------------------------------- bad files


def png_of(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), *chunks]
    parts += [(b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(name, body) for name, body in parts)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty (0 bytes)"),
        (b"\0" * 5000, "only zeros"),
        (b"<!DOCTYPE html><html>404</html>", "text, not an image"),
        (b"GIF89a" + b"\0" * 50, "a GIF"),
        (b"\0\0\0\x18ftypheic" + b"\0" * 50, "HEIC"),
        (b"II+\0" + b"\0" * 50, "truncated or a broken header"),
        (b"\xff\xd8\xff\xe0", "truncated"),
        (b"BM", "broken header"),
        (b"P5 10", "not an image"),
        (b"\x07", "not an image"),
        (png_of(100_000, 100_000), "100000x100000 is more than max_pixels"),
        (png_of(0, 10), "broken header: it claims 0x10 pixels"),
        (png_of(1, 1), "too small: 1x1"),
        (png_of(4000, 1), "too small: 4000x1"),
        (png_of(64, 64, (b"acTL", b"\0" * 8)), "animated (APNG)"),
        (png_of(64, 64)[:-3], "truncated"),
        (png_of(64, 64).replace(b"IDATx", b"IDATy"), "damaged: a checksum"),
        (b"P6 60000 60000 255\n", "truncated"),
    ],
)
def test_bad_bytes_are_skipped_with_their_reason(tmp_path: Path, data: bytes, reason: str) -> None:
    assert reason in skip_reason(tmp_path, "bad.jpg", data)


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "bmp", "webp", "ppm", "pgm"])
@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.98])
def test_truncated_files_are_skipped(tmp_path: Path, ending: str, fraction: float) -> None:
    whole = save(tmp_path / "whole" / f"a.{ending}", width=160, height=120).read_bytes()
    (tmp_path / "whole" / f"a.{ending}").unlink()
    assert skip_reason(tmp_path, f"cut.{ending}", whole[: int(len(whole) * fraction)])


@pytest.mark.parametrize(("ending", "reason"), [("webp", "animated"), ("png", "animated"), ("tif", "several pages")])
def test_files_of_several_pictures_are_skipped(tmp_path: Path, ending: str, reason: str) -> None:
    frames = [Image.open(save(tmp_path / "x" / f"{i}.png", seed=i)) for i in range(3)]
    frames[0].save(tmp_path / "x" / f"m.{ending}", save_all=True, append_images=frames[1:])
    data = (tmp_path / "x" / f"m.{ending}").read_bytes()
    for file in (tmp_path / "x").iterdir():
        file.unlink()
    assert reason in skip_reason(tmp_path, f"m.{ending}", data)


def test_other_kinds_of_tiff_and_jpeg_are_skipped(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((32, 48), np.float32)).save(tmp_path / "float.tif")
    Image.fromarray(np.zeros((32, 48), np.int32)).save(tmp_path / "signed.tif")
    jpeg = bytearray(save(tmp_path / "deep.jpg").read_bytes())
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 4] = 12
    (tmp_path / "deep.jpg").write_bytes(jpeg)
    jpeg[frame + 1] = 0xC3
    (tmp_path / "lossless.jpg").write_bytes(jpeg)
    skipped = dict(load(tmp_path)[0].skipped)
    assert "floating-point" in skipped["float.tif"]
    assert "signed" in skipped["signed.tif"]
    assert "12 bits" in skipped["deep.jpg"]
    assert "lossless" in skipped["lossless.jpg"]


def test_formats_that_are_not_read_are_named(tmp_path: Path) -> None:
    for name in ("a.heic", "b.CR2", "c.mp4", "d.gif"):
        (tmp_path / name).write_bytes(b"x")
    image_set, _, log = load(tmp_path)
    assert [name for name, _ in image_set.skipped] == ["a.heic", "b.CR2", "c.mp4", "d.gif"]
    assert any("c.mp4: .mp4 files are not read: name the video itself" in e.message for e in log)


def test_format_is_what_the_bytes_say(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", format="PNG")
    save(tmp_path / "b.png", seed=1, format="WEBP", lossless=True)
    image_set, report, _ = load(tmp_path)
    assert [entry["format"] for entry in report["images"]] == ["png", "webp"]
    assert read_picture(image_set.images[0]).rgb.shape == (32, 48, 3)


def test_things_that_are_no_files(tmp_path: Path) -> None:
    save(tmp_path / "good.png")
    (tmp_path / "folder.jpg").mkdir()
    save(tmp_path / "folder.jpg/inside.png")
    (tmp_path / "dangling.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "circle.jpg").symlink_to(tmp_path / "circle.jpg")
    (tmp_path / "device.jpg").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "again").symlink_to(tmp_path)
    image_set, _, _ = load(tmp_path)
    assert names(image_set) == ["good.png"]
    skipped = dict(image_set.skipped)
    assert skipped["folder.jpg"] == "a folder, not a file"
    assert skipped["dangling.jpg"] == "a link to a file that does not exist"
    assert skipped["circle.jpg"].startswith("cannot be read")
    assert skipped["device.jpg"] == skipped["pipe.jpg"] == "not a regular file"


def test_links_are_followed_but_real_names_count(tmp_path: Path) -> None:
    save(tmp_path / "photos/z/a.png")
    save(tmp_path / "other/b.png", seed=1)
    (tmp_path / "photos/a_link").symlink_to(tmp_path / "photos/z")
    (tmp_path / "photos/more").symlink_to(tmp_path / "other")
    assert names(load(tmp_path / "photos")[0]) == ["more/b.png", "z/a.png"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_forbidden_files_and_folders_by_mode(tmp_path: Path) -> None:
    save(tmp_path / "a.png").chmod(0)
    save(tmp_path / "sub/b.png").parent.chmod(0)
    skipped = dict(load(tmp_path)[0].skipped)
    assert skipped == {"a.png": "cannot be read: Permission denied", "sub/": "folder cannot be read: Permission denied"}


def test_forbidden_files_and_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same for root, whom modes do not stop."""
    save(tmp_path / "a.png")
    save(tmp_path / "sub/b.png")
    save(tmp_path / "good.png", seed=1)
    from sfmapp.images import folder as module

    def refuse(path: Any, *args: Any) -> Any:
        if os.fspath(path).endswith(("a.png", "sub")):
            raise PermissionError(13, "Permission denied")
        return (open if args else scandir)(path, *args)

    scandir = os.scandir
    monkeypatch.setattr(module, "open", refuse, raising=False)
    monkeypatch.setattr(module.os, "scandir", refuse)
    image_set, _, _ = load(tmp_path)
    assert names(image_set) == ["good.png"]
    assert dict(image_set.skipped) == {
        "a.png": "cannot be read: Permission denied",
        "sub/": "folder cannot be read: Permission denied",
    }


def test_names_that_cannot_be_written_down(tmp_path: Path) -> None:
    save(tmp_path / "good.png")
    data = (tmp_path / "good.png").read_bytes()
    for name in (b"bad\xff.png", b"new\nline.png"):
        with open(os.fsencode(tmp_path) + b"/" + name, "wb") as file:
            file.write(data)
    image_set, _, log = load(tmp_path)
    assert names(image_set) == ["good.png"]
    assert [name for name, _ in image_set.skipped] == ["bad\\xff.png", "new\\nline.png"]
    assert all(e.message.isprintable() for e in log)


def test_limits_on_size(tmp_path: Path) -> None:
    save(tmp_path / "a.bmp", width=48)
    save(tmp_path / "b.bmp", width=64)
    assert "max_pixels" in dict(load(tmp_path, max_pixels=48 * 32)[0].skipped)["b.bmp"]
    limit = (tmp_path / "a.bmp").stat().st_size
    assert "max_image_bytes" in dict(load(tmp_path, max_image_bytes=limit)[0].skipped)["b.bmp"]


def test_a_thousand_bad_files_are_one_warning(tmp_path: Path) -> None:
    for i in range(1000):
        (tmp_path / f"{i}.jpg").write_bytes(b"")
    image_set, _, log = load(tmp_path)
    assert len(image_set.skipped) == 1000
    assert next(e.message for e in log if e.kind == "warned") == (
        "skipped 0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, 5.jpg, 6.jpg, 7.jpg and 992 more: empty (0 bytes)"
    )


# ------------------------------------------------------------------------------------------------------------- fuzz


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "bmp", "webp", "ppm"])
def test_mutated_files_are_used_or_skipped_but_never_raise(tmp_path: Path, ending: str) -> None:
    """200 files per format with bytes flipped, mostly in the header; those that pass decode or say why not."""
    whole = save(tmp_path / "x" / f"a.{ending}", exif=exif_of(focal_mm=20.0, orientation=6)).read_bytes()
    (tmp_path / "x" / f"a.{ending}").unlink()
    rng = np.random.default_rng(list(ending.encode()))
    for i in range(200):
        data = bytearray(whole)
        reach = len(data) if i % 4 == 0 else min(len(data), 400)
        for place in rng.integers(0, reach, rng.integers(1, 6)):
            data[place] = rng.integers(0, 256)
        if i % 10 == 0:
            del data[int(rng.integers(1, len(data))) :]
        (tmp_path / f"{i}.{ending}").write_bytes(data)
    image_set, report, _ = load(tmp_path, max_pixels=1_000_000)
    assert len(image_set.images) + len(image_set.skipped) == 200
    assert all(reason for _, reason in image_set.skipped)
    num_decoded = 0
    for record in image_set.images:
        try:
            picture = read_picture(record)
        except InputError:
            continue
        assert picture.gray.shape == picture.rgb.shape[:2] == (record.height, record.width)
        num_decoded += 1
    assert report["num_used"] == len(image_set.images)
    assert num_decoded > 0 or ending == "png"  # a flipped byte in a PNG hardly ever passes its checksums


@pytest.mark.parametrize(
    "magic", [b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0\x08\0\0\0", b"BM", b"P6\n", b"RIFF____WEBPVP8X"]
)
def test_random_bytes_are_skipped(tmp_path: Path, magic: bytes) -> None:
    rng = np.random.default_rng(list(magic))
    for i in range(60):
        (tmp_path / f"{i}.jpg").write_bytes(magic + rng.bytes(int(rng.integers(0, 3000))))
    image_set, _, _ = load(tmp_path, max_pixels=1_000_000)
    for record in image_set.images:
        with pytest.raises(InputError):
            read_picture(record)
    assert len(image_set.skipped) >= 55


# -------------------------------------------------------------------------------------------------------- real data


@pytest.mark.real
@pytest.mark.skipif(not (DATA / "lund-door").is_dir(), reason=f"no real data in {DATA} (set SFMAPP_DATA)")
@pytest.mark.parametrize(
    ("name", "num_images", "source", "ground_truth"),
    [
        ("lund-door/images", 12, "exif_35mm", 2435.38),
        ("balbianello", 5, "exif_sensor", 518.69),
        ("fountain-P11/images", 11, "default", 1379.74),
        ("temple-sparse-ring/images", 16, "default", 1520.4),
    ],
)
def test_priors_of_real_cameras_hold_the_ground_truth(
    name: str, num_images: int, source: str, ground_truth: float
) -> None:
    image_set, _, _ = load(DATA / name)
    (camera,) = image_set.cameras
    assert len(image_set.images) == num_images
    assert camera.focal_source == source
    assert camera.focal_sigma is not None
    assert abs(camera.focal - ground_truth) < 2.0 * camera.focal_sigma
