"""What the progress listeners say, and that compiling beside the stages does not silence them."""

from __future__ import annotations

import pytest

from sfmapp.cli.progress import PlainLines
from sfmapp.events import Events


def test_stages_are_told_while_kernels_compile(capsys: pytest.CaptureFixture[str]) -> None:
    events = Events(PlainLines())
    events.started("features", "sift on 3 images", total=3)
    events.started("kernels", "compiling kernels, once")
    events.finished("features", "30 keypoints")
    events.started("pairs", "candidate pairs")
    events.started("alignment", "a step inside")
    events.finished("alignment")
    events.finished("pairs", "3 pairs")
    events.finished("kernels", "9 kernels compiled, once")
    said = [line.split(":")[0] for line in capsys.readouterr().err.splitlines()]
    assert said == ["features", "kernels", "features", "pairs", "pairs", "kernels"]


def test_quiet_passes_on_warnings_alone(capsys: pytest.CaptureFixture[str]) -> None:
    events = Events(PlainLines(is_quiet=True))
    events.started("features", total=1)
    events.warned("features", "dark.jpg: no features")
    events.finished("features")
    assert capsys.readouterr().err == "warning: dark.jpg: no features\n"
