"""Fixtures that all tests share: where the data lie."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from sfmapp.kernel_compiling import compile_sparingly
from sfmapp.packages import BLAS_THREADS

# As commands do, before numpy is loaded, here and in processes that tests start. Workers of pytest have a core each;
# on it threads of a BLAS that wait for one another spin, which costs up to a hundred times what they compute.
os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))

# the first example of a kernel may have to compile it; the same examples every time
settings.register_profile("sfmapp", deadline=None, derandomize=True)
settings.load_profile("sfmapp")

compile_sparingly()

CHECKOUT = Path(__file__).resolve().parent.parent
COMPILE_ALL = """
from sfmapp.events import Events
from sfmapp.kernel_cache import load_numba_sparingly
from sfmapp.workspace import kernels
load_numba_sparingly()
modules = (*kernels.MODULES, *kernels.ODOMETRY_MODULES, *kernels.DENSE_MODULES, *kernels.INERTIAL_MODULES)
with kernels.kernels_compiling(Events(), {}, tuple(dict.fromkeys(modules))):
    pass
"""


def pytest_configure(config: pytest.Config) -> None:
    """Have the kernels compiled once before xdist's workers begin with all tests, which would each compile the same at
    the same time."""
    is_all = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if is_all and config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        subprocess.run([sys.executable, "-c", COMPILE_ALL], check=False)  # what fails, fails in a test


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real data, SFMAPP_DATA or shared/data beside the checkout; skips where there is none."""
    root = Path(os.environ.get("SFMAPP_DATA", CHECKOUT.parent / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"real data not found in {root}; SFMAPP_DATA names its folder")
    return root


@pytest.fixture(scope="session")
def photos(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of seven neighbouring photographs of the sample at half size: a real job of about two seconds."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("photos")
    for path in sorted((sample / "images").iterdir())[:7]:
        with Image.open(path) as image:
            image.reduce(2).save(folder / f"{path.stem}.png")
    return folder


@pytest.fixture(scope="session")
def reconstructed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The workspace of a reconstruction of ``photos``, to be read only: copy it to write into it."""
    import sfmapp

    out = tmp_path_factory.mktemp("reconstructed") / "out"
    sfmapp.reconstruct(photos, out, record=False)
    return out


@pytest.fixture(scope="session")
def sample() -> Path:
    """Folder of the bundled sample, with images/ and cameras.json."""
    from sfmapp.errors import InputError
    from sfmapp.workspace.resources import sample_folder

    try:
        return sample_folder()
    except InputError as error:
        pytest.skip(str(error))
