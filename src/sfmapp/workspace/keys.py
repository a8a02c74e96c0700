"""Keys of stages: a stage whose key is unchanged need not run again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp.workspace.plain_json import canonical_json

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord

_PACKAGE = Path(__file__).resolve().parent.parent


def stage_key(packages: Sequence[str], options: Any, *inputs: Any) -> str:
    """Key of a stage: a hash of the source of the packages that it runs, its plain options and its plain inputs."""
    text = canonical_json([[source_digest(package) for package in packages], options, list(inputs)])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@cache
def source_digest(package: str) -> str:
    """Hash of the source files of one of our packages: the version of a stage that nobody has to remember to raise."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted((_PACKAGE / package).glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def input_key(record: ImageRecord) -> str:
    """Digest of an image's file and of whatever masks it."""
    key = record.digest + ("+alpha" if record.has_alpha else "")
    if record.mask_path is None:
        return key
    return f"{key}+mask:{hashlib.blake2b(record.mask_path.read_bytes(), digest_size=16).hexdigest()}"
