"""Keys of stages: a stage whose key is unchanged need not run again."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sfmapp.option_checks import is_resource
from sfmapp.workspace.code import source_digest
from sfmapp.workspace.options import options_to_dict
from sfmapp.workspace.plain_json import canonical_json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from sfmapp.images.image_set import ImageRecord


def stage_key(entries: Sequence[str], options: DataclassInstance | None, *inputs: Any) -> str:
    """Key of a stage: a hash of what its results follow from.

    Args:
        entries: names of the modules that the stage begins in; what they import counts as well.
        options: of the stage; those that say what it may take, and not what comes of it, have no part in the key.
        inputs: plain values.
    """
    text = canonical_json([source_digest(*entries), _of_results(options), list(inputs)])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _of_results(options: DataclassInstance | None) -> dict[str, Any]:
    if options is None:
        return {}
    plain = options_to_dict(options)
    return {field.name: plain[field.name] for field in dataclasses.fields(options) if not is_resource(field)}


def input_key(record: ImageRecord) -> str:
    """Digest of an image's file and of whatever masks it."""
    key = record.digest + ("+alpha" if record.has_alpha else "")
    if record.mask_path is None:
        return key
    return f"{key}+mask:{hashlib.blake2b(record.mask_path.read_bytes(), digest_size=16).hexdigest()}"
