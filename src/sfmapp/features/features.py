"""What extraction yields for one image; the type lives with the other plain data, below the file formats."""

from __future__ import annotations

from sfmapp.scene.features import Features

__all__ = ["Features"]
