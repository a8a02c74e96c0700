"""Make an environment in .venv and run the demo or the tests in it. Needs nothing but Python 3.11 to 3.13.

python3 get_started.py demo    installs sfmapp, reconstructs the bundled sample, compares it with the ground truth
python3 get_started.py test    installs sfmapp and what its tests need, runs them
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urljoin

HERE = Path(__file__).resolve().parent
ENVIRONMENT = HERE / ".venv"
PYTHON = ENVIRONMENT / "bin" / "python"
PIP_INDEX = "https://pypi.org/pypi/pip/json"
JOBS = {
    "demo": (".", ["-m", "sfmapp", "demo", "-o", "demo"]),
    "test": (".[test]", ["-m", "pytest", "--numprocesses=auto", "--dist=worksteal"]),
}


def main(arguments: list[str]) -> int:
    """Do the job that is named; further arguments go to it."""
    if not arguments or arguments[0] not in JOBS:
        print(__doc__)
        return 2
    if not (3, 11) <= sys.version_info[:2] <= (3, 13):
        print(f"Python 3.11 to 3.13 is needed, this is {sys.version.split()[0]}: try python3.12 {' '.join(sys.argv)}")
        return 2
    requirement, job = JOBS[arguments[0]]
    make_environment()
    run(PYTHON, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", requirement)
    return subprocess.run([PYTHON, *job, *arguments[1:]], cwd=HERE, check=False).returncode


def make_environment() -> None:
    """A virtual environment with pip, also where Debian's python3-venv, which brings pip, is not installed."""
    if not PYTHON.exists():
        print(f"making {ENVIRONMENT}", flush=True)
        run(sys.executable, "-m", "venv", "--without-pip", ENVIRONMENT)
    if not works(PYTHON, "-m", "pip", "--version") and not works(PYTHON, "-m", "ensurepip"):
        install_pip_from_index()


def install_pip_from_index() -> None:
    """Fetch pip's wheel; a wheel is a zip file that Python can run, so pip installs itself from it."""
    with urllib.request.urlopen(PIP_INDEX) as answer:
        (wheel,) = (file for file in json.load(answer)["urls"] if file["packagetype"] == "bdist_wheel")
        url = urljoin(answer.url, wheel["url"])
    with urllib.request.urlopen(url) as answer:
        content = answer.read()
    if hashlib.sha256(content).hexdigest() != wheel["digests"]["sha256"]:
        raise SystemExit(f"{url} is damaged: try again")
    path = ENVIRONMENT / wheel["filename"]
    path.write_bytes(content)
    run(PYTHON, path / "pip", "install", "--quiet", "--no-index", path)


def works(*command: str | Path) -> bool:
    """Whether a command ends well; what it says is nobody's business."""
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def run(*command: str | Path) -> None:
    """Run a command in this folder; end if it fails."""
    if code := subprocess.run(command, cwd=HERE, check=False).returncode:
        raise SystemExit(code)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
