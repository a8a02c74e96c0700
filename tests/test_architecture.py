"""The rules that a machine can hold: imports run downward, heavy packages stay where they belong."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import sfmapp

SOURCE = Path(sfmapp.__file__).parent

# from the top of the house to the ground; a room may import from its own floor only where it is the same room
FLOORS = (
    ("cli",),
    ("pipelines",),
    ("workspace",),
    ("report", "viewer"),
    ("odometry",),
    ("surface",),
    ("dense",),
    ("mapping",),
    ("adjust",),
    ("matching",),
    ("features",),
    ("sequences",),
    ("images",),
    ("calibration",),
    ("formats",),
    ("evaluation",),
    ("scene",),
    ("geometry",),
    ("camera",),
    ("simd",),
    ("contradictions",),
    ("events", "option_checks"),
    ("packages",),
    ("errors", "children", "kernel_cache"),
)
LEVEL = {room: level for level, floor in enumerate(FLOORS) for room in floor}
ALLOWED = {
    "rerun": {"viewer"},
    "gtsam": {"adjust", "odometry"},
    "pycolmap": {"formats", "evaluation"},
    "open3d": {"surface"},
    "xatlas": {"surface"},
    "av": {"images"},
    "rich": {"cli"},
    "argparse": {"cli", "evaluation", "viewer"},
}
# modules that "sfmapp --help" may not load
HEAVY = ("numpy", "numba", "cv2", "av", "gtsam", "pycolmap", "rerun", "scipy", "PIL", "rich")


def modules() -> list[Path]:
    return sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE or path.stem in LEVEL)


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "sfmapp":
                yield from (f"sfmapp.{alias.name}" for alias in node.names)
            elif node.module:
                yield node.module


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_downward(path: Path) -> None:
    room = room_of(path)
    for name in imports(path):
        top, _, rest = name.partition(".")
        if top == "sfmapp":
            other = rest.partition(".")[0]
            if other not in LEVEL:  # "import sfmapp" itself, for its version
                assert room in ("cli", "pipelines", "workspace"), f"{path} imports {name}"
            else:
                assert other == room or LEVEL[other] > LEVEL[room], f"{path} imports {name}, which is not below it"
        elif top in ALLOWED:
            assert room in ALLOWED[top], f"{path} imports {name}"


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(SOURCE)))
def test_library_does_not_print_exit_or_configure_logging(path: Path) -> None:
    # a module that is run as a child process speaks to its parent through its own output
    if room_of(path) == "cli" or '__name__ == "__main__"' in path.read_text(encoding="utf-8"):
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in ("print", "sys.exit", "exit", "logging.basicConfig"), f"{path}:{node.lineno} {called}"


def test_every_room_has_a_floor() -> None:
    rooms = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert rooms | {
        "contradictions",
        "events",
        "option_checks",
        "packages",
        "errors",
        "children",
        "kernel_cache",
    } == set(LEVEL)


@pytest.mark.parametrize("job", ["demo", "test"])
def test_the_readme_names_the_commands_that_set_all_up(job: str) -> None:
    checkout = Path(__file__).resolve().parent.parent
    assert f"python3 get_started.py {job}\n" in (checkout / "README.md").read_text(encoding="utf-8")
    assert f'"{job}":' in (checkout / "get_started.py").read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere() -> None:
    checkout = Path(__file__).resolve().parent.parent
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == sfmapp.__version__
    for requirement in project["dependencies"]:
        assert ">=" in requirement, requirement
        assert "<" in requirement, requirement


def test_help_is_light() -> None:
    code = (
        "import sys; from sfmapp.cli.main import make_parser; make_parser().format_help();"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded.strip() == "[]"
    shown = subprocess.run([sys.executable, "-m", "sfmapp", "--help"], capture_output=True, text=True, check=True)
    assert "reconstruct" in shown.stdout
