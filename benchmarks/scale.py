"""10,000 and 100,000 photographs on 16 to 256 workers, on paper: a simulation that replays measured costs of units.

    python benchmarks/scale.py --run OUT [OUT ...]   # measure the costs: of units from finished reconstructions
    python benchmarks/scale.py                       # simulate again with the costs that results/scale.json has

What is simulated is ``sfmapp reconstruct --cluster`` as it is: units that wait at the workers (two for each), a shared
file system that hands out bytes in turn, one process that takes results in turn, workers that are lost and replaced.
Costs of photographs and pairs are drawn from those that were measured, one by one.
"""

from __future__ import annotations

import argparse
import heapq
import json
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from machine import RESULTS, describe_machine

NUM_IMAGES, NUM_WORKERS = (10_000, 100_000), (16, 64, 256)
# of a file server on a network of 10 Gbit/s
STORAGE_BYTES_S = 1.0e9
# a worker in a thousand is lost in an hour; its successor begins after two minutes
LOSSES_PER_H, REPLACED_S = 1e-3, 120.0
AHEAD = 2
FEATURE_BYTES = 8192 * (128 + 16 + 3)
PAIRS_PER_UNIT, IMAGES_PER_UNIT = 64, 36
KEYPOINT_BYTES, MATCH_BYTES = 8192 * (16 + 3), 8


@dataclass(frozen=True)
class Costs:
    """CPU seconds.

    Attributes:
        image_s: features of single photographs.
        pair_s: matching of single pairs.
        unit_s: what a unit takes of the client and the scheduler, which sends it and takes word of it.
        take_image_s: reading features of a file and writing them into the database.
        take_pairs_s: taking 64 pairs.
        vector_s: making the vector that a photograph is looked up by.
        compare_s: comparing one vector with another.
        pairs_per_image: that are chosen.
        matches_per_pair: verified, the mean.
        photo_bytes: of the file of a photograph, the mean.
    """

    image_s: list[float]
    pair_s: list[float]
    unit_s: float
    take_image_s: float
    take_pairs_s: float
    vector_s: float
    compare_s: float
    pairs_per_image: float
    matches_per_pair: float
    photo_bytes: float


@dataclass
class Stage:
    """What a stage took in the simulation.

    Attributes:
        worker_s, client_s, storage_s: how long workers (all together), client and storage were at work.
        num_redone: units that were lost with their worker.
    """

    wall_s: float = 0.0
    worker_s: float = 0.0
    client_s: float = 0.0
    storage_s: float = 0.0
    num_redone: int = 0

    def limit(self, workers: int) -> str:
        """What was busiest, and for which share of the time."""
        shares = {
            "workers": self.worker_s / workers / self.wall_s,
            "client": self.client_s / self.wall_s,
            "storage": self.storage_s / self.wall_s,
        }
        name = max(shares, key=shares.__getitem__)
        return f"{name} {100 * shares[name]:.0f} %"


@dataclass
class Cluster:
    """Workers, a client that takes results in turn, and a storage that hands out bytes in turn."""

    workers: int
    rng: np.random.Generator
    stage: Stage = field(default_factory=Stage)

    def run(self, compute_s: Sequence[float], bytes_read: float, bytes_written: float, take_s: float) -> Stage:
        """Do units, each of which reads, computes, writes and is taken by the client, and wait for the last."""
        ready: list[float] = [0.0] * self.workers  # when each worker is free
        heapq.heapify(ready)
        waiting = deque(range(len(compute_s)))
        sent: list[tuple[float, int]] = []  # units that come home, by when
        storage_free = client_free = 0.0
        out = self.stage
        transfer_s = (bytes_read + bytes_written) / STORAGE_BYTES_S
        tokens = deque([0.0] * (AHEAD * self.workers))  # when the client has sent one more
        while waiting or sent:
            if waiting and tokens and (not sent or max(ready[0], tokens[0]) <= sent[0][0]):
                unit = waiting.popleft()
                begin = max(heapq.heappop(ready), tokens.popleft())
                storage_free = max(storage_free, begin) + transfer_s
                end = storage_free + compute_s[unit]
                out.storage_s += transfer_s
                out.worker_s += end - begin
                if self.rng.random() < -np.expm1(-(end - begin) / 3600.0 * LOSSES_PER_H):
                    heapq.heappush(ready, end + REPLACED_S)
                    waiting.appendleft(unit)
                    tokens.appendleft(end)
                    out.num_redone += 1
                else:
                    heapq.heappush(ready, end)
                    heapq.heappush(sent, (end, unit))
            else:
                end, _ = heapq.heappop(sent)
                client_free = max(client_free, end) + take_s
                out.client_s += take_s
                tokens.append(client_free)
        out.wall_s = client_free
        return out


def simulated(num_images: int, workers: int, costs: Costs, seed: int = 0) -> dict[str, Any]:
    """One run: features, choice of pairs, matching."""
    rng = np.random.default_rng([seed, num_images, workers])
    features = Cluster(workers, rng).run(
        rng.choice(costs.image_s, num_images), costs.photo_bytes, FEATURE_BYTES, costs.unit_s + costs.take_image_s
    )
    num_pairs = round(num_images * costs.pairs_per_image)
    num_units = -(-num_pairs // PAIRS_PER_UNIT)
    blocks = rng.choice(costs.pair_s, (num_units, PAIRS_PER_UNIT)).sum(axis=1)
    matching = Cluster(workers, rng).run(
        blocks, IMAGES_PER_UNIT * FEATURE_BYTES, 0.0, costs.unit_s + costs.take_pairs_s
    )
    pairs_s = num_images * costs.vector_s + num_images**2 * costs.compare_s
    match_bytes = num_pairs * costs.matches_per_pair * MATCH_BYTES
    return {
        "images": num_images, "workers": workers,
        "features_s": features.wall_s, "features_limit": features.limit(workers),
        "pairs_s": pairs_s,
        "matching_s": matching.wall_s, "matching_limit": matching.limit(workers),
        "redone": features.num_redone + matching.num_redone,
        "read_gb": 1e-9 * (num_images * costs.photo_bytes + num_units * IMAGES_PER_UNIT * FEATURE_BYTES),
        "written_gb": 1e-9 * num_images * FEATURE_BYTES,
        "sent_gb": 1e-9 * match_bytes,
        "client_gb": 1e-9 * (num_images * KEYPOINT_BYTES + match_bytes + 4 * num_images * 8192),
    }  # fmt: skip


# ------------------------------------------------------------------------------------------------------------ measuring


def measured(runs: Sequence[Path]) -> Costs:
    """Costs of units from reports of finished reconstructions, the others here."""
    image_s, pair_s, matches, verified, sizes = [], [], 0, 0, []
    for run in runs:
        root = Path(json.loads((run / "run.json").read_text())["image_root"])
        stages = json.loads((run / "report.json").read_text())["stages"]
        image_s += [row["cpu_s"] for row in stages["features"]["images"] if row.get("cpu_s")]
        sizes += [(root / row["name"]).stat().st_size for row in stages["features"]["images"]]
        pair_s += [row["cpu_s"] for row in stages["matching"]["pairs"]]
        matches += stages["matching"]["num_matches"]
        verified += len(stages["matching"]["pairs"])
    with tempfile.TemporaryDirectory() as folder:
        return Costs(
            image_s, pair_s, _unit_s(Path(folder)), *_take_s(Path(folder), matches / verified), *_vector_s(),
            pairs_per_image=_pairs_per_image(), matches_per_pair=matches / verified,
            photo_bytes=float(np.mean(sizes)),
        )  # fmt: skip


def _unit_s(folder: Path) -> float:
    from sfmapp.cluster.dask_executor import open_cluster
    from sfmapp.events import Events

    with open_cluster("local:1", folder, [], Events()) as executor:
        list(executor.run(abs, [1] * 50))
        return _cpu_s(lambda: list(executor.run(abs, [1] * 500))) / 500


def _take_s(folder: Path, matches_per_pair: float) -> tuple[float, float]:
    from sfmapp.camera.camera import CameraModel, simple_camera
    from sfmapp.formats.feature_files import read_feature_file, write_feature_file
    from sfmapp.images.image_set import ImageRecord, ImageSet
    from sfmapp.matching.stage import MatchedPair
    from sfmapp.matching.two_view import TwoViewGeometry
    from sfmapp.scene.correspondences import TwoViewConfig
    from sfmapp.scene.features import Features
    from sfmapp.workspace.store import Store

    rng, num = np.random.default_rng(0), 40
    records = tuple(ImageRecord(str(i), folder / str(i), 3200, 2133) for i in range(num))
    features = Features(
        rng.random((8192, 4), np.float32), rng.integers(0, 100, (8192, 128), np.uint8), np.zeros((8192, 3), np.uint8)
    )
    write_feature_file(folder / "features.npz", features)
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, 3200, 2133, 3000.0)
    matrix = np.zeros((3, 3))
    geometry = TwoViewGeometry(
        TwoViewConfig.CALIBRATED, np.empty(0, bool), matrix, matrix, matrix, np.zeros(7), 1.0, 0, 0, 0
    )
    pair = MatchedPair(np.zeros((round(matches_per_pair), 2), np.int32), 0, geometry)
    pairs = [(i, j) for i in range(num) for j in range(i + 1, num)][: 8 * PAIRS_PER_UNIT]
    with Store(folder / "database.db", ImageSet(records, (camera,)), ["key"] * num, "pairs") as store:
        image_s = _cpu_s(
            lambda: [store.put_features(i, read_feature_file(folder / "features.npz")) for i in range(num)]
        )
        pairs_s = _cpu_s(lambda: ([store.put_pair(i, j, pair) for i, j in pairs], store.flush()))
    return image_s / num, pairs_s / 8


def _vector_s() -> tuple[float, float]:
    from sfmapp.matching.pairs import PairOptions, image_vector, nearest_vectors

    rng, options = np.random.default_rng(0), PairOptions()
    descriptors = rng.integers(0, 100, (options.num_query_features, 128)).astype(np.float32)
    words = rng.integers(0, 100, (options.num_words, 128)).astype(np.float32)
    vectors = rng.random((3000, words.size), np.float32)
    return (
        _cpu_s(lambda: [image_vector(descriptors, words) for _ in range(20)]) / 20,
        _cpu_s(lambda: nearest_vectors(vectors, options.num_neighbors)) / 3000**2,
    )


def _pairs_per_image() -> float:
    """Retrieval gives each image some neighbours, and about two in three of them also have it as theirs."""
    from sfmapp.matching.pairs import PairOptions

    return PairOptions().num_neighbors * 2.0 / 3.0


def _cpu_s(work: Callable[[], Any]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def markdown(report: dict[str, Any]) -> str:
    """The tables."""
    costs = report["costs"]
    unit_ms, image_ms, pairs_ms = (1000 * costs[name] for name in ("unit_s", "take_image_s", "take_pairs_s"))
    pair_ms, photo_mb = 1000 * np.mean(costs["pair_s"]), costs["photo_bytes"] / 1e6
    lines = [
        f"Measured {report['date'][:10]}, {report['commit']}, {report['cpu']}: a photograph of {photo_mb:.1f} MB"
        f" {np.mean(costs['image_s']):.2f} CPU s, a pair {pair_ms:.0f} ms; of the client {unit_ms:.1f} ms for a unit,"
        f" {image_ms:.1f} ms for features of an image, {pairs_ms:.1f} ms for 64 pairs.",
        "",
        "| photographs | workers | features, h | busiest | pairs, h | matching, h | busiest | done again"
        " | read, written, sent, GB | memory of the client, GB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {row['images']:,} | {row['workers']} | {row['features_s'] / 3600:.2f} | {row['features_limit']} |"
        f" {row['pairs_s'] / 3600:.2f} | {row['matching_s'] / 3600:.2f} | {row['matching_limit']} | {row['redone']} |"
        f" {row['read_gb']:.0f}, {row['written_gb']:.0f}, {row['sent_gb']:.1f} | {row['client_gb']:.1f} |"
        for row in report["rows"]
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs="+", type=Path, help="finished reconstructions, whose units are replayed")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "scale.json")
    args = parser.parse_args()
    if args.run:
        report = describe_machine() | {"costs": asdict(measured(args.run))}
    else:
        report = json.loads(args.output.read_text())
    costs = Costs(**report["costs"])
    report["rows"] = [simulated(images, workers, costs) for images in NUM_IMAGES for workers in NUM_WORKERS]
    args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
