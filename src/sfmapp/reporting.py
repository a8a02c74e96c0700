"""Typed reports: what a stage or a run says of itself, as frozen dataclasses that JSON can hold.

A report is made by subclassing :class:`Report`; HTML, terminal and JSON are renderings of the same objects. Nothing is
computed from a report that was written: what a later run needs stands in the results or in ``run.json``.

:func:`json_default` alone knows how values become JSON, and :func:`from_plain` how they come back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, TypeAlias, TypeVar, Union, dataclass_transform

Plain: TypeAlias = "bool | int | float | str | Sequence[Plain] | Mapping[str, Plain] | None"
"""What JSON holds."""


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(field,))
class Report(Mapping[str, Any]):
    """Base of all reports: a subclass is a frozen dataclass, its arguments given by name (unless ``kw_only=False``).

    It reads as a mapping from the names of its fields to their values as well, so ``report["models"][0]["num_points"]``
    is ``report.models[0].num_points``, and equals any mapping with the same entries. Fields hold numbers, text, other
    reports, and sequences and mappings of these. One whose default is None is no entry of the mapping, nor of the JSON,
    where it is None.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]
    __match_args__: ClassVar[tuple[str, ...]]

    def __init_subclass__(cls, *, kw_only: bool = True) -> None:
        # Methods that a dataclass has written and compiled for it are those below, which all share: a run loads 180
        # reports, and that was an eighth of what it loads.
        dataclass(init=False, repr=False, eq=False, kw_only=kw_only)(cls)

    def __init__(self, *given: Any, **values: Any) -> None:
        names = self.__match_args__[: len(given)]
        if len(given) > len(names) or values.keys() & names:
            raise TypeError(f"{type(self).__name__}: expected each field once, and by name where it has to be")
        values.update(zip(names, given, strict=True))
        for name, known in self.__dataclass_fields__.items():
            if name in values:
                self.__dict__[name] = values.pop(name)
            elif known.default is not dataclasses.MISSING:
                self.__dict__[name] = known.default
            elif known.default_factory is not dataclasses.MISSING:
                self.__dict__[name] = known.default_factory()
            else:
                raise TypeError(f"{type(self).__name__}: {name!r} is missing")
        if values:
            raise TypeError(f"{type(self).__name__}: {min(values)!r} is not one of its fields")

    if not typing.TYPE_CHECKING:  # to which reports are frozen anyway

        def __setattr__(self, name: str, value: object) -> None:
            raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")

        def __delattr__(self, name: str) -> None:
            raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.__dict__.items())})"

    def __getitem__(self, name: str) -> Any:
        known = self.__dataclass_fields__.get(name)
        if known is None:
            raise KeyError(name)
        value = getattr(self, name)
        if value is None and known.default is None:
            raise KeyError(name)
        return value

    def __iter__(self) -> Iterator[str]:
        for name, known in self.__dataclass_fields__.items():
            if known.default is not None or getattr(self, name) is not None:
                yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)


class Usage(Report):
    """What a run, a stage or a child process took.

    Attributes:
        wall_s: seconds that went by.
        cpu_s: seconds of processors, of all threads and of children that have ended.
        peak_memory_mb: largest resident set of the process so far, 1e6 bytes; absent for what ran beside the stages.
        num_compiled: kernels that had to be compiled; absent elsewhere.
    """

    wall_s: float
    cpu_s: float
    peak_memory_mb: float | None = None
    num_compiled: int | None = None


class Step(Report):
    """What was left after a step that takes things away."""

    name: str
    count: int


class NamedReason(Report):
    """A file or image and why it could not be used."""

    name: str
    reason: str


# ------------------------------------------------------------------------------------------------------------- to JSON


def json_default(value: Any) -> Any:
    """What JSON makes of reports, of numpy's scalars and arrays, of sets and of paths; for ``json.dumps(default=...)``.

    Numbers that are not finite are written as Python's ``json`` does: ``NaN`` and ``Infinity``.
    """
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def to_json(value: Any, indent: int | None = None) -> str:
    """A report, or whatever holds some, as JSON."""
    return json.dumps(value, indent=indent, default=json_default)


def document_text(report: Mapping[str, Any]) -> str:
    """JSON with a line for each entry of the outermost objects and lists: readable, and written in one go."""
    parts = []
    for key, value in report.items():
        if isinstance(value, list | tuple) and value:
            text = "[\n  " + ",\n  ".join(to_json(entry) for entry in value) + "\n ]"
        else:
            text = to_json(value)
        parts.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def plain(value: Any) -> Any:
    """A report as dicts, lists, text and numbers alone."""
    return json.loads(to_json(value))


# ----------------------------------------------------------------------------------------------------------- from JSON

R = TypeVar("R", bound=Report)


def from_plain(kind: type[R], value: object) -> R:
    """The report that :func:`to_json` has written.

    Raises:
        ValueError: it is none of this kind; the message names the field, what was expected and what was found.
    """
    found = _read(kind, value, kind.__name__)
    assert isinstance(found, kind)
    return found


@cache
def field_types(kind: type[Report]) -> dict[str, tuple[Any, bool]]:
    """By name of the field, its type and whether it may be left out of JSON."""
    hints = typing.get_type_hints(kind)
    return {known.name: (hints[known.name], known.default is None) for known in dataclasses.fields(kind)}


def _read(kind: Any, value: Any, place: str) -> Any:
    """A value as a type of a field has it."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        others = [argument for argument in arguments if argument is not type(None)]
        if not all(_is_report(other) for other in others):
            return _read(others[0], value, place) if len(others) == 1 else value
        return _read_one_of(others, value, place)
    if _is_report(kind):
        return _read_report(kind, _checked(value, dict, place), place)
    if origin is tuple and arguments[-1] is not ...:
        entries = _checked(value, list, place)
        if len(entries) != len(arguments):
            raise ValueError(f"{place}: expected {len(arguments)} entries, found {len(entries)}")
        return tuple(_read(k, v, f"{place}[{n}]") for n, (k, v) in enumerate(zip(arguments, entries, strict=True)))
    if origin in (list, tuple, Sequence):
        return [_read(arguments[0], v, f"{place}[{n}]") for n, v in enumerate(_checked(value, list, place))]
    if origin in (dict, Mapping):
        return {k: _read(arguments[1], v, f"{place}[{k!r}]") for k, v in _checked(value, dict, place).items()}
    if origin is typing.Literal:
        if value not in arguments:
            raise ValueError(f"{place}: expected one of {arguments}, found {value!r}")
        return value
    if kind in (bool, int, float, str):
        return _checked(value, (int, float) if kind is float else kind, place, is_flag=kind is bool)
    return value


def _is_report(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Report)


def _read_one_of(kinds: Sequence[type[Report]], value: Any, place: str) -> Report:
    """The first kind that fits; what is wrong with the last where none does."""
    for kind in kinds[:-1]:
        with contextlib.suppress(ValueError):
            return _read_report(kind, _checked(value, dict, place), place)
    return _read_report(kinds[-1], _checked(value, dict, place), place)


def _read_report(kind: type[Report], value: dict[str, object], place: str) -> Report:
    known = field_types(kind)
    if unknown := sorted(set(value) - set(known)):
        raise ValueError(f"{place}: {unknown[0]!r} is not one of its fields")
    if missing := [name for name, (_, is_optional) in known.items() if name not in value and not is_optional]:
        raise ValueError(f"{place}: {missing[0]!r} is missing")
    return kind(**{name: _read(known[name][0], entry, f"{place}.{name}") for name, entry in value.items()})


def _checked(value: Any, kind: type | tuple[type, ...], place: str, *, is_flag: bool = False) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and not is_flag):
        wanted = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        raise ValueError(f"{place}: expected {wanted}, found {type(value).__name__}")
    return value
