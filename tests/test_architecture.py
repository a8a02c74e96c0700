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
    ("api",),
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
    ("reporting",),
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
    alone = {"contradictions", "events", "option_checks", "packages", "errors", "children", "kernel_cache", "reporting"}
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
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node


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
