"""Options: defaults, presets, files and the command line; and the refusal of everything misspelt or impossible."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.camera.camera import CameraModel
from sfmapp.errors import UsageError
from sfmapp.odometry.options import OdometryOptions
from sfmapp.option_checks import Range, positive
from sfmapp.workspace import resources
from sfmapp.workspace.options import (
    Options,
    field_comments,
    list_options,
    load_options,
    options_from_dict,
    options_to_dict,
    parse_setting,
)
from sfmapp.workspace.plain_json import canonical_json


def test_defaults_survive_the_round_trip_through_json() -> None:
    plain = json.loads(json.dumps(options_to_dict(Options())))
    assert options_from_dict(plain) == Options()


@given(
    seed=st.integers(0, 2**40),
    model=st.sampled_from(list(CameraModel)),
    focal=st.none() | st.floats(1, 1e5),
    ratio=st.floats(0.1, 1),
    alpha=st.booleans(),
)
def test_any_options_survive_the_round_trip(
    seed: int, model: CameraModel, focal: float | None, ratio: float, alpha: bool
) -> None:
    options = Options(seed=seed)
    images = dataclasses.replace(options.images, camera_model=model, focal_px=focal, use_alpha=alpha)
    options = dataclasses.replace(
        options, images=images, matching=dataclasses.replace(options.matching, max_ratio=ratio)
    )
    assert options_from_dict(json.loads(canonical_json(options_to_dict(options)))) == options
    settings = [f"seed={seed}", f"images.camera_model={model.name.lower()}", f"images.focal_px={focal}"]
    assert load_options(settings=[*settings, f"images.use_alpha={alpha}", f"matching.max_ratio={ratio!r}"]) == options


def test_later_layers_win(tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text('seed = 3\n[features]\nkind = "orb"\nmax_num_features = 100\n')
    second.write_text("[features]\nmax_num_features = 200\n")
    options = load_options(
        [str(first), str(second)], ["features.max_num_features=300", "features.max_num_features=400"]
    )
    assert (options.seed, options.features.kind, options.features.max_num_features) == (3, "orb", 400)
    assert load_options([str(first), str(second)]).features.max_num_features == 200


def test_shipped_presets_load_and_differ() -> None:
    assert {"default", "fast", "quality"} <= set(resources.preset_names())
    assert load_options(["default"]) == Options()
    assert len({canonical_json(options_to_dict(load_options([name]))) for name in ("default", "fast", "quality")}) == 3


@pytest.mark.parametrize(
    ("setting", "named", "advice"),
    [
        ("features.max_num_feature=3", "features.max_num_feature", "features.max_num_features"),
        ("feature.max_num_features=3", "feature", "features"),
        ("max_num_features=3", "max_num_features", "features.max_num_features"),
        ("features.kind=sifft", "features.kind", "sift"),
        ("images.camera_model=OPENVC", "images.camera_model", "OPENCV"),
        ("features.max_num_features=many", "features.max_num_features", None),
        ("features.max_num_features=2.5", "features.max_num_features", None),
        ("features.max_num_features=inf", "features.max_num_features", None),
        ("features.max_num_features=-5", "max_num_features", None),
        ("matching.max_ratio=nan", "matching.max_ratio", None),
        ("images.use_alpha=maybe", "images.use_alpha", None),
        ("images.camera_params=1,x,3,4", "images.camera_params", None),
        ("features=3", "features", None),
        ("features.kind.name=3", "features.kind", None),
        ("seed=-1", "seed", None),
        ("threads=0", "threads", None),
        ("min_registered=0", "min_registered", None),
        ("nonsense", "nonsense", None),
        ("=3", "=3", None),
    ],
)
def test_wrong_settings_are_refused_by_name(setting: str, named: str, advice: str | None) -> None:
    with pytest.raises(UsageError) as caught:
        load_options(settings=[setting])
    assert named in str(caught.value)
    if advice:
        assert advice in str(caught.value.advice)


@pytest.mark.parametrize(
    "setting",
    [
        "matching.max_ratio=0", "matching.max_ratio=1.2", "matching.max_distance=-0.1", "matching.min_inliers=2",
        "matching.min_e_f_ratio=1.1", "matching.max_error_px=0", "matching.max_ransac_trials=0",
        "mapping.min_pose_inliers=0", "mapping.min_pose_inlier_ratio=50", "mapping.max_reprojection_error_px=-1",
        "mapping.global_growth=0.5", "mapping.min_model_images=1", "mapping.min_initial_angle_deg=180",
        "mapping.refine_principal_point=sometimes", "adjust.loss=welsch", "adjust.loss_scale_px=0",
        "adjust.max_iterations=0", "adjust.initial_damping=-1e-4", "adjust.distortion_sigma=0",
        "odometry.max_tracks=-600", "odometry.max_tracks=1e9", "odometry.keyframe_loss=65", "odometry.window=1",
        "odometry.window_anchors=-1", "odometry.min_triangulation_deg=0", "odometry.max_lost_s=-1",
        "odometry.motion=flying", "pairs.num_words=0", "features.memory_mb=0", "sequence.step=0", "images.max_pixels=0",
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_by_name(setting: str) -> None:
    name = setting.partition("=")[0]
    with pytest.raises(UsageError, match=f"^{name}: expected .*, got "):
        load_options(settings=[setting])


def test_a_range_says_what_it_holds() -> None:
    assert [str(r) for r in (Range(2, 8), Range(1), positive(), positive(2), Range(0.5, is_open=True))] == [
        "2 to 8", "1 or more", "a positive number", "a positive number up to 2", "more than 0.5"
    ]  # fmt: skip
    assert [value in positive(2) for value in (0.0, 1e-300, 2.0, 2.1, float("nan"))] == [
        False,
        True,
        True,
        False,
        False,
    ]
    assert [value in Range(0, 1) for value in (-1e-9, 0, 1, 1.1)] == [False, True, True, False]


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"max_tracks": 600.0}, "a whole number"), ({"max_tracks": True}, "a whole number"),
        ({"keyframe_loss": "0.5"}, "a finite number"), ({"max_lost_s": float("inf")}, "a finite number"),
        ({"loops": 1}, "true or false"), ({"motion": "wheels"}, "one of free, planar, ackermann"),
        ({"window": None}, "a whole"),
    ],
)  # fmt: skip
def test_options_made_in_code_are_checked_as_well(wrong: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError, match=f"odometry.{next(iter(wrong))}: expected {expected}"):
        OdometryOptions(**wrong)


@pytest.mark.parametrize("text", ["seed = ", "[nosuch]\na = 1", "[features]\nkind = 3", "features = 3", "seed = true"])
def test_wrong_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(UsageError):
        load_options([str(path)])


def test_missing_presets_are_refused_with_the_nearest_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        load_options(["qualty"])
    assert "quality" in str(caught.value.advice)
    with pytest.raises(UsageError, match="No such file"):
        load_options([str(tmp_path / "none.toml")])


@given(st.text())
def test_no_setting_escapes_the_error_classes(text: str) -> None:
    with contextlib.suppress(UsageError):
        load_options(settings=[text])


def test_settings_keep_equals_signs_in_values() -> None:
    assert parse_setting("a.b = x=y ") == {"a": {"b": "x=y"}}


def test_every_option_is_listed_with_its_meaning() -> None:
    rows = {name: (kind, default, comment) for name, kind, default, comment in list_options()}
    assert rows["images.camera_model"][1] == "SIMPLE_RADIAL"
    assert rows["threads"][:2] == ("int or auto", "auto")
    assert [name for name, (_, _, comment) in rows.items() if not comment] == []
    # what is listed as default can be set
    assert load_options(settings=[f"{name}={default}" for name, (_, default, _) in rows.items()]) == Options()


@dataclasses.dataclass(frozen=True)
class Sample:
    """What it is.

    Attributes:
        first, second: a length,
            over two lines: the first, and the other.
        third: the third

    And so on: fourth: not this.
    """

    first: int = 1
    second: int = 2
    third: int = 3
    fourth: int = 4


def test_comments_are_read_from_the_docstring() -> None:
    length = "a length, over two lines: the first, and the other."
    assert field_comments(Sample) == {"first": length, "second": length, "third": "the third", "fourth": ""}
