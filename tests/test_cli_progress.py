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


def test_steps_whose_number_nobody_knows_are_told_by_what_they_say(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sfmapp.cli.progress.PLAIN_PERIOD_S", 0.0)
    events = Events(PlainLines())
    events.started("mapping", total=10)
    events.started("bundle adjustment", "1000 images")
    events.advanced("bundle adjustment", message="step 1 of at most 25, cost 12.5")
    events.advanced("mapping", 5)
    said = capsys.readouterr().err.splitlines()
    assert said[1] == "bundle adjustment: step 1 of at most 25, cost 12.5"
    assert said[2].startswith("mapping: 5 of 10, about ")
