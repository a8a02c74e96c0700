"""Which source files a stage runs: what it imports, within functions and by name as well, and nothing else."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sfmapp.pipelines.sparse import keys
from sfmapp.workspace import code

SHELL = ("cli", "workspace", "report", "viewer")
STAGES = {
    "features": keys.FEATURES,
    "pairs": keys.PAIRS,
    "matching": keys.MATCHING,
    "mapping": keys.MAPPING,
    "dense": ("sfmapp.pipelines.dense.densify",),
    "mesh": ("sfmapp.pipelines.dense.mesh",),
    "undistort": ("sfmapp.pipelines.undistort",),
}


def forget() -> None:
    for function in (code.source_digest, code.imported, code.path_of, code._is_room, code._source):
        function.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], Path]]:
    """Puts a copy of a folder in the place of the package."""

    def place(source: Path) -> Path:
        folder = tmp_path / "sfmapp"
        shutil.copytree(source, folder, ignore=shutil.ignore_patterns("__pycache__"))
        monkeypatch.setattr(code, "PACKAGE", folder)
        forget()
        return folder

    yield place
    forget()


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        (path.parent / "__init__.py").touch()
    return folder


def test_imports_are_followed_wherever_they_stand(tmp_path: Path, package: Callable[[Path], Path]) -> None:
    made = {
        "top/stage": (
            "from __future__ import annotations\nfrom typing import TYPE_CHECKING\n"
            "from sfmapp.low import a\nfrom sfmapp.low.b import (\n    X,\n    Y as Z,\n)\n"
            "if TYPE_CHECKING:\n    from sfmapp.low import types_only\n\n    from sfmapp.low.more_types import T\n\n"
            "def run():\n    from sfmapp.low import late as later\n    import sfmapp.low.whole\n"
            '    return ["-m", "sfmapp.low.child"], "sfmapp.no.such"\n'
        ),
        "low/a": "from sfmapp.low import further\nfrom sfmapp.report import page\n",
        "report/page": "from sfmapp.low import shown\n",
        **{
            f"low/{name}": ""
            for name in ["b", "late", "whole", "child", "further", "types_only", "more_types", "stranger", "shown"]
        },
    }
    folder = package(write(tmp_path / "made", made))
    inside = {f"sfmapp.low.{name}" for name in ("a", "b", "late", "whole", "child", "further")}
    assert code.closure("sfmapp.top.stage") == {"sfmapp.top.stage", *inside}
    before = code.source_digest("sfmapp.top.stage")
    for name in made:
        module = "sfmapp." + name.replace("/", ".")
        text = (folder / f"{name}.py").read_text(encoding="utf-8")
        (folder / f"{name}.py").write_text(text + "# touched\n", encoding="utf-8")
        forget()
        assert (code.source_digest("sfmapp.top.stage") != before) == (module in {"sfmapp.top.stage", *inside}), name
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    forget()
    assert code.source_digest("sfmapp.top.stage") == before


def parsed(module: str) -> set[str]:
    """What a module imports, as the parser has it."""
    path = code.path_of(module)
    assert path is not None
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        match node:
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                for other in node.orelse:
                    visit(other)
                return
            case ast.Import():
                found.update(alias.name for alias in node.names if alias.name.startswith("sfmapp."))
            case ast.ImportFrom(module=str(base)) if base.split(".")[0] == "sfmapp":
                names = [f"{base}.{alias.name}" for alias in node.names]
                found.update(name if code.path_of(name) else base for name in names)
            case ast.Constant(value=str(text)) if text.removeprefix("sfmapp.") not in (text, "") and code.path_of(text):
                found.add(text)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return {name for name in found if name not in ("sfmapp", module)}


def parsed_closure(entries: tuple[str, ...]) -> set[str]:
    found: set[str] = set()
    ahead = set(entries)
    while ahead:
        found |= ahead
        ahead = {name for module in ahead for name in parsed(module) if name.split(".")[1] not in SHELL} - found
    return found


def test_the_scan_finds_what_the_parser_finds() -> None:
    for path in sorted(code.PACKAGE.rglob("*.py")):
        parts = path.relative_to(code.PACKAGE).with_suffix("").parts
        module = ".".join(("sfmapp", *parts)).removesuffix(".__init__")
        assert code.imported(module) == parsed(module), module


@pytest.mark.parametrize("stage", ["features", "matching", "mapping"])
def test_what_is_loaded_is_in_the_key(stage: str) -> None:
    """Python itself loads nothing else, the package and its rooms aside."""
    program = (
        "import importlib, json, sys\n"
        f"for name in {STAGES[stage]!r}: importlib.import_module(name)\n"
        "print(json.dumps([name for name, module in sys.modules.items()\n"
        "    if name.startswith('sfmapp.') and not hasattr(module, '__path__')]))"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert set(json.loads(shown)) - {"sfmapp.kernel_cache", "sfmapp.kernel_compiling"} <= code.closure(*STAGES[stage])


@pytest.mark.parametrize(
    ("module", "touched"),
    [
        (
            "features.sift",
            {"features", "dense"},
        ),  # patches of two views also come by stereo, which looks between keypoints
        ("matching.guided", {"matching"}),
        ("mapping.register", {"mapping"}),
        ("adjust.problem", {"mapping", "dense", "mesh", "undistort"}),  # a calibration given to these adjusts poses
        ("dense.growth", {"dense"}),
        ("surface.poisson", {"mesh"}),
        ("report.html", set()),
        ("workspace.job", set()),
        ("odometry.run", set()),
        ("cli.main", set()),
    ],
)
def test_a_change_touches_the_stages_that_run_it(
    module: str, touched: set[str], package: Callable[[Path], Path]
) -> None:
    folder = package(code.PACKAGE)
    before = {stage: code.source_digest(*entries) for stage, entries in STAGES.items()}
    path = folder / (module.replace(".", "/") + ".py")
    path.write_text(path.read_text(encoding="utf-8") + "\n# a fix\n", encoding="utf-8")
    forget()
    assert {stage for stage, entries in STAGES.items() if code.source_digest(*entries) != before[stage]} == touched


@pytest.mark.parametrize("module", ["camera.camera", "geometry.rigid3", "images.pixels", "simd.f64x8", "scene.mesh"])
def test_a_change_of_what_stages_share_touches_just_those_that_import_it(
    module: str, package: Callable[[Path], Path]
) -> None:
    importing = {stage for stage, entries in STAGES.items() if f"sfmapp.{module}" in parsed_closure(entries)}
    assert len(importing) > 0
    test_a_change_touches_the_stages_that_run_it(module, importing, package)
