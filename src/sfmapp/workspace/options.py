"""The options of a whole run: one frozen class per stage, filled from defaults, presets, files and the command line."""

from __future__ import annotations

import dataclasses
import difflib
import enum
import inspect
import math
import os
import textwrap
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sfmapp.adjust.options import AdjustOptions
from sfmapp.carve.options import CarveOptions, MaskOptions
from sfmapp.cluster.address import num_local
from sfmapp.dense.options import DenseOptions
from sfmapp.errors import SfmError, UsageError
from sfmapp.features.extract import FeatureOptions
from sfmapp.georeference.control.options import ControlOptions
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.poses.options import PoseOptions
from sfmapp.georeference.unit_options import UnitOptions
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.sequence import SequenceOptions
from sfmapp.mapping.options import MappingOptions
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.pairs import PairOptions
from sfmapp.odometry.options import OdometryOptions, ScaleOptions
from sfmapp.option_checks import Range, check_options
from sfmapp.stereo.options import StereoOptions
from sfmapp.surface.options import SurfaceOptions
from sfmapp.video.options import VideoOptions
from sfmapp.workspace import resources

LIST_ADVICE = "sfmapp reconstruct --list-options shows every option with its default"


@dataclass(frozen=True)
class Options:
    """Options of all stages of a run. The options of a stage live next to its code.

    Attributes:
        images, video, features, pairs, matching, mapping, adjust, gps: the options of the stages of a reconstruction.
        control, units, poses: ground control points of a reconstruction, known lengths and the vertical, known poses.
        dense, surface: those of patches and of the mesh that is made of them.
        sequence, odometry, scale: those of odometry.
        stereo: those of matching rectified pairs.
        masks, carve: those of silhouettes, and of the volume that they leave.
        seed: where every random choice starts; the same seed gives the same bytes.
        threads: worker threads; None: as many as the process has cores. Results do not depend on it.
        cluster: workers for features and matches of photographs: ``local:N`` for N processes of this machine,
            ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` for those of a scheduler of dask. None: threads of this process.
            Results do not depend on it.
        min_registered: fail (exit code 5) when fewer images are registered; None: any model will do.
    """

    images: ImageOptions = field(default_factory=ImageOptions)
    video: VideoOptions = field(default_factory=VideoOptions)
    features: FeatureOptions = field(default_factory=FeatureOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    control: ControlOptions = field(default_factory=ControlOptions)
    units: UnitOptions = field(default_factory=UnitOptions)
    poses: PoseOptions = field(default_factory=PoseOptions)
    gps: GpsOptions = field(default_factory=GpsOptions)
    dense: DenseOptions = field(default_factory=DenseOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    sequence: SequenceOptions = field(default_factory=SequenceOptions)
    odometry: OdometryOptions = field(default_factory=OdometryOptions)
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    stereo: StereoOptions = field(default_factory=StereoOptions)
    masks: MaskOptions = field(default_factory=MaskOptions)
    carve: CarveOptions = field(default_factory=CarveOptions)
    seed: int = 0
    threads: int | None = None
    cluster: str | None = None
    min_registered: int | None = None

    def __post_init__(self) -> None:
        check_options("", self, {"seed": Range(0), "threads": Range(1), "min_registered": Range(2)})
        if self.cluster is not None:
            num_local(self.cluster)

    @property
    def num_workers(self) -> int:
        """``threads``, or the cores that this process may use."""
        return num_threads(self.threads)


def num_threads(threads: int | None) -> int:
    """As many as are asked for, or the cores that this process may use."""
    return threads or len(os.sched_getaffinity(0))


def load_options(presets: Iterable[str] = (), settings: Iterable[str] = ()) -> Options:
    """The options of a whole run: defaults, then presets in order, then settings; the last word counts.

    Args:
        presets: names of presets (``default``, ``fast``, ``quality``), or paths of TOML files.
        settings: texts ``stage.option=value``; ``sfmapp reconstruct --list-options`` shows them all.

    Returns:
        The options, checked.

    Raises:
        UsageError: an unknown preset, stage or option, or an impossible value; it names the nearest right spelling.

    Example:
        >>> options = sfmapp.load_options(presets=["quality"], settings=["images.camera_model=OPENCV"])
    """
    values: dict[str, Any] = {}
    for preset in presets:
        _merge(values, read_preset(preset))
    for setting in settings:
        _merge(values, parse_setting(setting))
    return options_from_dict(values)


def options_from_dict(values: Mapping[str, Any]) -> Options:
    """Options of nested plain values, as in a TOML file or ``run.json``; what is not named keeps its default."""
    options: Options = _build(Options, values, "")
    return options


def with_absolute_paths(options: Options) -> Options:
    """The same options, good in any working directory."""
    images = _with_absolute_paths(options.images, "camera", "mask_path")
    control = _with_absolute_paths(options.control, "file")
    poses = _with_absolute_paths(options.poses, "file")
    sequence = _with_absolute_paths(options.sequence, "camera", "imu", "ground_truth")
    odometry = _with_absolute_paths(options.odometry, "known_map")
    masks = _with_absolute_paths(options.masks, "background")
    gps = options.gps if options.gps.source in ("exif", "none") else _with_absolute_paths(options.gps, "source")
    return dataclasses.replace(
        options, images=images, control=control, poses=poses, sequence=sequence, odometry=odometry, masks=masks, gps=gps
    )


def _with_absolute_paths(stage: Any, *names: str) -> Any:
    given = {name: path for name in names if (path := getattr(stage, name)) is not None}
    # a camera may be a file or numbers
    found = {name: os.path.abspath(path) for name, path in given.items() if name != "camera" or os.path.exists(path)}
    return dataclasses.replace(stage, **found) if found else stage


def options_to_dict(options: Any) -> dict[str, Any]:
    """Nested plain values of an options class, JSON-able: enums as names, tuples as lists."""
    return {f.name: _plain(getattr(options, f.name)) for f in dataclasses.fields(options)}


def read_preset(name_or_path: str) -> dict[str, Any]:
    """Nested values of a preset that ships with sfmapp (by name) or of a TOML file of the user's (by path).

    Raises:
        UsageError: there is no such preset or file, or it is not TOML.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and not path.is_file():
        path = resources.find_preset(name_or_path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"preset {path}: {error}", "a preset is a TOML file with a table per stage") from error


def parse_setting(setting: str) -> dict[str, Any]:
    """``stage.option=value`` as nested values; the value stays text until its option is known.

    Raises:
        UsageError: no equals sign in it.
    """
    name, equals, value = setting.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"--set {setting}: expected stage.option=value", LIST_ADVICE)
    nested: Any = value.strip()
    for part in reversed(name.strip().split(".")):
        nested = {part: nested}
    return typing.cast(dict[str, Any], nested)


def list_options() -> list[tuple[str, str, str, str]]:
    """(name, type, default, comment) of every option, in the order of the stages."""
    rows = []
    for name, annotation, value, comment in _rows(Options()):
        if dataclasses.is_dataclass(value):
            rows += [(f"{name}.{n}", _type_name(a), _text(v), c) for n, a, v, c in _rows(value)]
        else:
            rows.append((name, _type_name(annotation), _text(value), comment))
    return rows


def _rows(options: Any) -> list[tuple[str, Any, Any, str]]:
    comments = field_comments(type(options))
    hints = typing.get_type_hints(type(options))
    return [(f.name, hints[f.name], getattr(options, f.name), comments[f.name]) for f in dataclasses.fields(options)]


def field_comments(options_class: type) -> dict[str, str]:
    """What ``Attributes:`` in the docstring of a class says about each of its fields; empty for nothing."""
    comments = {f.name: "" for f in dataclasses.fields(options_class)}
    _, _, section = inspect.cleandoc(options_class.__doc__ or "").partition("Attributes:\n")
    for entry in textwrap.dedent(section.split("\n\n")[0]).replace("\n    ", " ").splitlines():
        names, _, text = entry.partition(":")
        comments |= {name: text.strip() for name in map(str.strip, names.split(",")) if name in comments}
    return comments


def _merge(into: dict[str, Any], values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if isinstance(value, Mapping) and isinstance(into.get(name), dict):
            _merge(into[name], value)
        else:
            into[name] = dict(value) if isinstance(value, Mapping) else value


def _build(options_class: type, values: Any, prefix: str) -> Any:
    """An instance of a (nested) options class from plain values, every name and value checked."""
    if not isinstance(values, Mapping):
        raise UsageError(f"{prefix.rstrip('.')} is a stage, not an option: got {values!r}", LIST_ADVICE)
    hints = typing.get_type_hints(options_class)
    arguments = {}
    for name, value in values.items():
        if name not in hints:
            raise UsageError(f"there is no option {prefix}{name}", _nearest(prefix, name))
        if dataclasses.is_dataclass(hints[name]):
            arguments[name] = _build(hints[name], value, f"{prefix}{name}.")
        else:
            arguments[name] = _convert(value, hints[name], f"{prefix}{name}")
    try:
        return options_class(**arguments)
    except SfmError:
        raise
    except (ValueError, TypeError) as error:
        raise UsageError(f"{prefix.rstrip('.') or 'options'}: {error}", LIST_ADVICE) from error


def _nearest(prefix: str, name: str) -> str:
    """Advice with the right spelling that is nearest to a wrong one; the stage counts less than the option."""
    names = [row[0] for row in list_options()]
    stages = sorted({full.partition(".")[0] for full in names if "." in full})
    wrong = f"{prefix}{name}"
    near = difflib.get_close_matches(wrong, names + stages, 3, 0.6)
    by_option = {full.rpartition(".")[2]: full for full in names}
    near += [by_option[n] for n in difflib.get_close_matches(name.rpartition(".")[2], list(by_option), 2, 0.7)]
    near = list(dict.fromkeys(near))[:3]
    return f"did you mean {' or '.join(near)}? {LIST_ADVICE}" if near else LIST_ADVICE


def _convert(value: Any, annotation: Any, where: str) -> Any:
    """A plain value or its text, as the annotated type. Text is parsed, so TOML can spell None as "auto"."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, arguments, where)
    if origin is typing.Literal:
        for choice in arguments:
            if value == choice or str(value) == str(choice):
                return choice
        raise _impossible(where, value, f"one of {', '.join(map(str, arguments))}", [str(a) for a in arguments])
    if origin is tuple:
        return _convert_tuple(value, arguments, where)
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        spelling = str(value).strip().upper().replace("-", "_")
        if spelling in annotation.__members__:
            return annotation[spelling]
        names = list(annotation.__members__)
        raise _impossible(where, str(value).upper(), f"one of {', '.join(names)}", names)
    return _convert_scalar(value, annotation, where)


def _convert_union(value: Any, choices: tuple[Any, ...], where: str) -> Any:
    is_none = value is None or (isinstance(value, str) and value.strip().lower() in ("none", "auto"))
    if is_none and type(None) in choices:
        return None
    failures = []
    for choice in choices:
        if choice is not type(None):
            try:
                return _convert(value, choice, where)
            except UsageError as error:
                failures.append(error)
    raise failures[0]


def _convert_tuple(value: Any, arguments: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    parts = [part for part in value.split(",") if part.strip()] if isinstance(value, str) else value
    if not isinstance(parts, list | tuple):
        raise _impossible(where, value, "a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return tuple(_convert(part, arguments[0], where) for part in parts)
    if len(parts) != len(arguments):
        raise _impossible(where, value, f"{len(arguments)} values")
    return tuple(_convert(part, kind, where) for part, kind in zip(parts, arguments, strict=True))


def _convert_scalar(value: Any, kind: Any, where: str) -> Any:
    text = value.strip() if isinstance(value, str) else None
    if kind is bool:
        spellings = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False}
        spellings["0"] = False
        if isinstance(value, bool):
            return value
        if text is not None and text.lower() in spellings:
            return spellings[text.lower()]
        raise _impossible(where, value, "true or false")
    if kind in (int, float):
        try:
            number = float(text) if text is not None else value
            if isinstance(number, bool) or not isinstance(number, int | float) or math.isnan(number):
                raise ValueError
            if kind is int and number != int(number):
                raise ValueError
            return int(text) if kind is int and text is not None and text.lstrip("+-").isdigit() else kind(number)
        except (ValueError, OverflowError) as error:
            raise _impossible(where, value, "a whole number" if kind is int else "a number") from error
    if kind is str and isinstance(value, str):
        return value
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    raise _impossible(where, value, getattr(kind, "__name__", str(kind)))


def _impossible(where: str, value: Any, expected: str, choices: list[str] | None = None) -> UsageError:
    near = difflib.get_close_matches(str(value), choices or [], 1, 0.5)
    return UsageError(f"{where}: expected {expected}, got {value!r}", f"did you mean {near[0]}?" if near else None)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return options_to_dict(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value


def _text(value: Any) -> str:
    """A default as one would write it after ``--set``."""
    plain = _plain(value)
    if plain is None:
        return "auto"
    if isinstance(plain, bool):
        return str(plain).lower()
    return ",".join(map(str, plain)) if isinstance(plain, list) else str(plain)


def _type_name(annotation: Any) -> str:
    """A type as a person reads it: ``int or auto``, ``sift|orb``."""
    arguments = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_name(a) if a is not type(None) else "auto" for a in arguments)
    if origin is typing.Literal:
        return "|".join(map(str, arguments))
    if origin is tuple:
        return "list of " + _type_name(arguments[0])
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return "|".join(annotation.__members__)
    return getattr(annotation, "__name__", str(annotation))


def flat_options(options: Options) -> dict[str, Any]:
    """Plain values by the names that options have on the command line."""
    return _flat(options_to_dict(options), "")


def _flat(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in values.items():
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return out
