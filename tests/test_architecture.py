"""The rules that a machine can hold: imports run downward and in no circle, heavy packages stay where they belong."""

from __future__ import annotations

import ast
import gc
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import sfmapp

SOURCE = Path(sfmapp.__file__).parent

# from the top of the house to the ground; a room may import from its own floor only where it is the same room
FLOORS = (
    ("cli",),
    ("api",),
    ("pipelines",),
    ("workspace",),
    ("report", "viewer"),
    ("video",),
    ("odometry",),
    ("carve",),
    ("surface",),
    ("stereo",),
    ("dense",),
    ("georeference",),
    ("planes",),
    ("calibration",),
    ("twoview",),
    ("panorama",),
    ("uncalibrated",),
    ("mapping",),
    ("adjust",),
    ("matching",),
    ("features",),
    ("sequences",),
    ("cluster",),
    ("images",),
    ("camera_files",),
    ("formats",),
    ("evaluation",),
    ("scene",),
    ("geometry",),
    ("camera",),
    ("simd",),
    ("contradictions",),
    ("events", "option_checks"),
    ("executor", "packages"),
    ("errors", "children", "kernel_cache"),
    ("kernel_compiling", "reporting"),
)
# the same inside the rooms that have rooms of their own; * is every part that is named nowhere else
INNER_FLOORS = {
    "odometry": (
        ("run",),
        ("early_calibration",),
        ("live_shutter",),
        ("frames_adjustment", "known_map_check", "missed_frames", "recognition", "shutter"),
        ("records",),
        ("tracker", "initialize", "stereo_clock"),
        ("refinement",),
        ("belief",),
        ("loops",),
        ("map",),
        ("frontend",),
        ("keyframe_images", "motion_model", "snapshot"),
        ("result", "state"),
        ("inertial",),
        ("report",),
        ("options", "residual_memory"),
    ),
    "pipelines": (
        ("*",),
        ("export_world",),
        ("calibration", "dense", "odometry", "planning"),
        ("sparse",),
        ("calibrated_model",),
        ("lens_fit", "metres", "stored_pixels"),
    ),
}
LEVEL = {room: level for level, floor in enumerate(FLOORS) for room in floor}
ALLOWED = {
    "distributed": {"cluster"},
    "rerun": {"viewer"},
    "gtsam": {"adjust", "georeference", "odometry"},
    "pycolmap": {"formats", "evaluation"},
    "pyproj": {"georeference"},
    "mcap": {"formats"},
    "open3d": {"surface"},
    "rosbags": {"formats"},
    "xatlas": {"surface"},
    "av": {"images"},
    "rich": {"cli"},
    "argparse": {"cli", "evaluation", "viewer"},
}
# modules that "sfmapp --help" may not load
HEAVY = ("numpy", "numba", "cv2", "av", "gtsam", "pycolmap", "rerun", "scipy", "PIL", "pyproj", "rich", "email")


@cache
def modules() -> Mapping[str, Path]:
    """Files by name of the module; ``sfmapp`` itself, the face of the house, imports what it likes."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        if parts[0] in LEVEL or name.split(".")[0] in LEVEL:
            found[f"sfmapp.{name}"] = path
    return found


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """Calls, imports, strings and functions of a file."""
    wanted = (ast.Call, ast.Constant, ast.Import, ast.ImportFrom, ast.FunctionDef, ast.AsyncFunctionDef)
    # nothing of a syntax tree is garbage, and looking for some, over and over, takes longer than everything else here
    gc.disable()
    try:
        return [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, wanted)]
    finally:
        gc.enable()


def named_modules(path: Path) -> Iterator[str]:
    """Modules of ours that a file names in strings: for importlib, or to be run as a child."""
    texts = (node.value for node in nodes_of(path) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    yield from (text for text in texts if text.startswith("sfmapp.") and re.fullmatch(r"sfmapp(\.[a-z_0-9]+)+", text))


@cache
def imports(name: str) -> frozenset[str]:
    """What a module imports, of ours as module names, at any place: in functions, for type checkers, and by name."""
    path, found = modules()[name], set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules().keys() or {str(node.module)}
            found |= {str(node.module)} if inner - modules().keys() else set()
    return frozenset((found | set(named_modules(path))) - {name})


def room_of(name: str) -> str:
    return name.split(".")[1]


def test_imports_run_downward() -> None:
    wrong = []
    for name in modules():
        room = room_of(name)
        for other in imports(name):
            top = other.partition(".")[0]
            if other == "sfmapp":  # for its version
                if room not in ("cli", "pipelines", "workspace"):
                    wrong.append(f"{name} imports sfmapp itself")
            elif top == "sfmapp":
                if room_of(other) != room and LEVEL.get(room_of(other), -1) <= LEVEL[room]:
                    wrong.append(f"{name} imports {other}, which is not below it")
            elif top in ALLOWED and room not in ALLOWED[top]:
                wrong.append(f"{name} imports {other}, which belongs to {', '.join(sorted(ALLOWED[top]))}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("room", sorted(INNER_FLOORS))
def test_imports_run_downward_inside_a_room(room: str) -> None:
    levels = {part: level for level, floor in enumerate(INNER_FLOORS[room]) for part in floor}
    inside = {name: name.split(".")[2] for name in modules() if name.startswith(f"sfmapp.{room}.")}
    free = set(inside.values()) - set(levels)
    assert set(levels) - {"*"} <= set(inside.values()), f"{room} has no such part, but INNER_FLOORS names it"
    assert "*" in levels or not free, f"give every part of {room} a floor in INNER_FLOORS"
    levels.update(dict.fromkeys(free, levels.get("*", -1)))
    wrong = [
        f"{name} imports {other}, which is not below it"
        for name, part in inside.items()
        for other in sorted(imports(name) & inside.keys())
        if inside[other] != part and levels[inside[other]] <= levels[part]
    ]
    assert not wrong, "\n".join(wrong)


def test_imports_run_in_no_circle() -> None:
    """File by file, imports within functions and for type checkers included: who knows whom is no riddle."""
    graph = {name: imports(name) & modules().keys() for name in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("imports in a circle: " + " is imported by ".join(error.args[1]))


def test_modules_named_in_strings_exist() -> None:
    """A list for importlib, the homes of public names, and what is run with -m."""
    known = {"sfmapp", *modules()}
    for path in SOURCE.rglob("*.py"):
        missing = set(named_modules(path)) - known
        assert not missing, f"{path} names {missing}"
    for name, home in sfmapp._HOMES.items():
        assert f"sfmapp.{home}" in known, f"{name} lives in {home}"


def test_children_can_be_run() -> None:
    """What library modules name in strings is run with -m, and has a main part."""
    children = {child for name, path in modules().items() for child in named_modules(path)
                if room_of(name) not in ("pipelines", "workspace")}  # fmt: skip
    assert len(children) >= 5
    for child in children:
        assert '__name__ == "__main__"' in modules()[child].read_text(encoding="utf-8"), child


def test_library_does_not_print_exit_or_configure_logging() -> None:
    for name, path in modules().items():
        # a module that is run as a child process speaks to its parent through its own output
        if room_of(name) == "cli" or '__name__ == "__main__"' in path.read_text(encoding="utf-8"):
            continue
        for node in nodes_of(path):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
                # most calls are of methods, which are dear to write out
                is_plain = isinstance(node.func, ast.Name) or isinstance(node.func.value, ast.Name)
                called = ast.unparse(node.func) if is_plain else ""
                wrong = called in ("print", "sys.exit", "exit", "logging.basicConfig")
                assert not wrong, f"{path}:{node.lineno} {called}"


def test_every_room_has_a_floor() -> None:
    rooms = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    alone = {
        "contradictions",
        "events",
        "option_checks",
        "packages",
        "errors",
        "children",
        "kernel_cache",
        "kernel_compiling",
        "reporting",
        "executor",
    }
    assert rooms | alone == set(LEVEL)


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


# ---- argument lists: what belongs together goes by one name, a dataclass of options or state, a NamedTuple of arrays

MOST_PARAMETERS, MOST_OF_KERNELS = 8, 12
# what users call with keywords, each of which stands for itself
LONG_LISTS = {
    "api/jobs.py track_sequence",
    "api/jobs.py undistort",
    "api/live.py __init__",
    "api/stages.py match_images",
    "matching/stage.py match_images",
    "scene/synthetic.py make_scene",
}


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    a = function.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs]
    return [arg.arg for arg in every if arg.arg not in ("self", "cls", "typingctx")]


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    decorators = " ".join(ast.unparse(decorator) for decorator in function.decorator_list)
    return "njit" in decorators or "intrinsic" in decorators


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (node for node in nodes_of(path) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def test_argument_lists_are_short() -> None:
    benchmarks = Path(__file__).resolve().parent.parent / "benchmarks"
    long_lists, long_kernels = set(), set()
    for folder in (SOURCE, benchmarks):
        for path in folder.rglob("*.py"):
            for function in functions(path):
                name, num = f"{path.relative_to(folder)} {function.name}", len(parameters(function))
                if is_kernel(function) and num > MOST_OF_KERNELS:
                    long_kernels.add(name)
                elif not is_kernel(function) and num > MOST_PARAMETERS:
                    long_lists.add(name)
    assert long_kernels == set()
    assert long_lists == LONG_LISTS


def test_code_for_the_compiler_stays_in_one_room() -> None:
    for path in modules():
        if room_of(path) != "simd":
            written = [name for name in imports(path) if name.startswith(("llvmlite", "numba.extending"))]
            assert written == [], f"{path} writes LLVM code, which belongs into simd"
