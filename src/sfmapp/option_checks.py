"""Options that cannot be obeyed, refused in one place: every field of an options class against its type and range."""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

from sfmapp.errors import UsageError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class Range:
    """The numbers that an option may be, both ends among them unless ``is_open`` leaves the lower one out."""

    least: float
    most: float = math.inf
    is_open: bool = False

    def __contains__(self, value: float) -> bool:
        return (self.least < value if self.is_open else self.least <= value) and value <= self.most

    def __str__(self) -> str:
        if self.is_open:
            lower = "a positive number" if self.least == 0 else f"more than {self.least:g}"
            return lower if math.isinf(self.most) else f"{lower} up to {self.most:g}"
        return f"{self.least:g} or more" if math.isinf(self.most) else f"{self.least:g} to {self.most:g}"


def positive(most: float = math.inf) -> Range:
    """More than 0, and no more than ``most``."""
    return Range(0.0, most, is_open=True)


RESOURCE: Mapping[str, Any] = {"is_resource": True}
"""Metadata of an option that says what a run may take, such as memory: results do not depend on it, nor do keys."""

SHARE = Range(0.0, 1.0)
"""A share of a whole, 0 and 1 among them."""


def is_resource(field: dataclasses.Field[Any]) -> bool:
    """Whether an option says what a run may take, and not what comes of it."""
    return bool(field.metadata.get("is_resource"))


def check_options(stage: str, options: DataclassInstance, ranges: Mapping[str, Range]) -> None:
    """Check the fields of an options class; for its ``__post_init__``.

    Numbers have to be finite and in their range, switches true or false, and what is annotated as a ``Literal`` has to
    be one of its values. None passes where the annotation has it. Fields of other types are left to the class.

    Args:
        stage: name of the stage, which begins the message, as in ``--set STAGE.OPTION``; empty for those of no stage.
        options: what was made; only its fields are read.
        ranges: of its numbers, by name of the field.

    Raises:
        UsageError: names the first field that is wrong, what it may be, and what it is.
    """
    kinds = _kinds(type(options))
    for field in fields(options):
        value, (kind, may_be_none, choices) = getattr(options, field.name), kinds[field.name]
        if value is None and may_be_none:
            continue
        expected = _fault(value, kind, choices, ranges.get(field.name))
        if expected:
            name = f"{stage}.{field.name}" if stage else field.name
            raise UsageError(f"{name}: expected {expected}, got {value!r}")


def _fault(value: Any, kind: Any, choices: tuple[Any, ...], allowed: Range | None) -> str:
    """What a value should have been; empty if it is right."""
    if choices:
        return "" if value in choices else f"one of {', '.join(map(str, choices))}"
    if kind is bool:
        return "" if isinstance(value, bool) else "true or false"
    if kind in (int, float):
        number = numbers.Integral if kind is int else numbers.Real
        if isinstance(value, bool) or not isinstance(value, number) or not math.isfinite(value):
            return "a whole number" if kind is int else "a finite number"
        return "" if allowed is None or float(value) in allowed else str(allowed)
    return ""


@functools.cache
def _kinds(options_class: type) -> dict[str, tuple[Any, bool, tuple[Any, ...]]]:
    """The type of each field, whether it may be None, and the values of a ``Literal``."""
    found = {}
    for name, hint in typing.get_type_hints(options_class).items():
        parts = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
        plain = [part for part in parts if part is not type(None)]
        kind = plain[0] if len(plain) == 1 else None
        choices = typing.get_args(kind) if typing.get_origin(kind) is Literal else ()
        found[name] = kind, len(plain) < len(parts), choices
    return found
