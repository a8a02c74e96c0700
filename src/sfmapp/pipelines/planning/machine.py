"""How fast this machine is, by one run of the bundled sample, which is remembered.

Every stage is measured at its own real work, so that a faster kernel, another processor or another release changes the
estimate by itself: what is known of the costs of stages is kept in multiples of the sample's.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from sfmapp.children import with_parent
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import FeatureOptions, bytes_of_extraction
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.report import ImageFacts
from sfmapp.report.model import ReconstructionReport
from sfmapp.reporting import Report, Usage, from_plain
from sfmapp.workspace.code import source_digest
from sfmapp.workspace.layout import REPORT
from sfmapp.workspace.resources import sample_folder
from sfmapp.workspace.user_cache import recall, remember

STAGE = "calibration"
_KIND = "machines"
# a run of the sample takes seconds, its first one a minute, for it compiles
_TIMEOUT_S = 1800.0
# More processes than this for each core that want it, and caches and memory are shared with others.
BUSY = 0.75


class Machine(Report):
    """The run of the sample by which a machine is known.

    Attributes:
        processor, cores: the cores that the process may use.
        calibrated: date and time in UTC.
        load: processes that wanted a core before it began, over the last minute.
        usage: of each stage; run: of the whole.
        image_cpu_s: features of all images, without what the stage takes beside them.
        pair_cpu_s: the same of its pairs.
        num_images, num_features, megapixels, num_pairs, num_matches, num_observations: of the sample.
        extraction_mb: memory of the workers that extract features, 1e6 bytes.
    """

    processor: str
    cores: int
    calibrated: str
    load: float
    usage: Mapping[str, Usage]
    run: Usage
    image_cpu_s: float
    pair_cpu_s: float
    num_images: int
    num_features: int
    megapixels: float
    extraction_mb: float
    num_pairs: int
    num_matches: int
    num_observations: int
    threads: int

    @property
    def is_busy(self) -> bool:
        """Others were at work when it was measured."""
        return self.load > BUSY * self.cores


def known_machine(events: Events) -> Machine:
    """This machine as it was measured, or as it is measured now: once for each version of the package and processor,
    and again where others were at work the last time and no longer are.

    Raises:
        InputError: the sample is not there, or cannot be reconstructed.
    """
    key = _key()
    known = recall(_KIND, key, Machine)
    if known is not None and not (known.is_busy and load() <= BUSY * known.cores):
        return known
    events.started(STAGE, "measuring this machine by the bundled sample, once", total=2)
    measured = _measure(events)
    remember(_KIND, key, measured)
    beside = f", while others were at work (load {measured.load:.1f})" if measured.is_busy else ""
    events.finished(STAGE, f"{measured.run.cpu_s:.1f} CPU s{beside}", **measured)
    return measured


def load() -> float:
    """Processes that want a core, over the last minute; 0 where the system does not tell."""
    try:
        return os.getloadavg()[0]
    except OSError:
        return 0.0


def processor() -> str:
    """Its name."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def num_cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0))


def _key() -> str:
    import sfmapp

    text = [sfmapp.__version__, source_digest("sfmapp.pipelines.sparse.reconstruct"), processor(), num_cores()]
    return hashlib.blake2b(json.dumps(text).encode(), digest_size=16).hexdigest()


def _measure(events: Events) -> Machine:
    """Reconstruct the sample twice at most: where kernels had to be compiled, the first run tells nothing."""
    before = load()
    for _ in range(2):
        events.advanced(STAGE)
        with tempfile.TemporaryDirectory(prefix="sfmapp-calibration-") as folder:
            report = _run_sample(Path(folder) / "out")
        if not report.usage["kernels"].num_compiled:
            break
    return machine_of(report, before)


def machine_of(report: ReconstructionReport, load: float) -> Machine:
    """What the report of a run tells of the machine that it ran on, with so much at work beside it."""
    stages, model = report.stages, report.models[0]
    assert stages.images is not None
    assert stages.features is not None
    assert stages.matching is not None
    return Machine(
        processor=processor(),
        cores=num_cores(),
        calibrated=datetime.now(UTC).isoformat(timespec="seconds"),
        load=load,
        usage=report.usage,
        run=Usage(wall_s=report.run.wall_s, cpu_s=report.run.cpu_s, peak_memory_mb=report.run.peak_memory_mb),
        image_cpu_s=sum(image.cpu_s or 0.0 for image in stages.features.images),
        pair_cpu_s=stages.matching.cpu_s,
        num_images=len(report.images),
        num_features=stages.features.num_features,
        extraction_mb=_extraction_mb(stages.images.images, report.run.threads),
        megapixels=sum(image.width * image.height for image in stages.images.images) / 1e6,
        num_pairs=stages.matching.num_pairs,
        num_matches=stages.matching.num_matches,
        num_observations=model.num_observations,
        threads=report.run.threads,
    )


def _extraction_mb(images: Sequence[ImageFacts], threads: int) -> float:
    records = [ImageRecord(image.name, Path(image.name), image.width, image.height) for image in images]
    return threads * max(bytes_of_extraction(record, FeatureOptions()) for record in records) / 1e6


def _run_sample(output: Path) -> ReconstructionReport:
    """The report of a run of the command itself, in a process of its own."""
    arguments = ["reconstruct", str(sample_folder() / "images"), "-o", str(output), "-q"]
    command = with_parent([sys.executable, "-P", "-m", "sfmapp", *arguments])
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=_TIMEOUT_S,
        check=False, text=True, errors="replace",
    )  # fmt: skip
    try:
        if done.returncode:
            raise ValueError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"code {done.returncode}")
        return from_plain(ReconstructionReport, json.loads((output / REPORT).read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(
            f"the bundled sample could not be reconstructed to measure this machine: {error}",
            "run sfmapp demo to see why",
        ) from error
