"""Memory of SIFT on photographs of 6.8 megapixels, on two workers.

    SFMAPP_DATA=... python benchmarks/memory.py --before /tmp/earlier/src    # the package of another checkout beside

Photographs of 1.5 megapixels are put together to larger ones: four of fountain-P11 side by side, scaled to
3200 x 2133. Each package runs in a process of its own; its peak holds the interpreter, numpy, OpenCV and the kernels.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import RESULTS, describe_machine

DATA = Path(os.environ.get("SFMAPP_DATA", "data"))
SIZES = ((3200, 2133),)
NUM_PICTURES, NUM_WORKERS = 6, 2
MOST_MB = 700.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="source folder of an earlier checkout")
    parser.add_argument("--extract", metavar="FOLDER", help="extract and print; what this script calls")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "memory.json")
    args = parser.parse_args()
    if args.extract:
        print(json.dumps(extracted(args.extract)))
        return
    rows = []
    for size in SIZES:
        with tempfile.TemporaryDirectory() as folder:
            make_pictures(Path(folder), size)
            row = {"case": f"SIFT, {size[0]} x {size[1]}, {NUM_WORKERS} workers", "most_mb": MOST_MB}
            row |= in_child(folder, Path(__file__).resolve().parent.parent / "src")
            if args.before is not None:
                before = in_child(folder, args.before)
                row |= {f"before_{key}": value for key, value in before.items()}
            rows.append(row)
            print(row, flush=True)
    report = describe_machine() | {"rows": rows}
    args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.output.with_suffix(".md").write_text(table(report), encoding="utf-8")


def make_pictures(folder: Path, size: tuple[int, int]) -> None:
    """Pictures of a size, each of four photographs."""
    import cv2
    import numpy as np

    photographs = [cv2.imread(str(path)) for path in sorted((DATA / "fountain-P11" / "images").iterdir())]
    for n in range(NUM_PICTURES):
        a, b, c, d = photographs[n : n + 4]
        whole = cv2.resize(np.vstack([np.hstack([a, b]), np.hstack([c, d])]), size, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{n}.jpg"), whole, [cv2.IMWRITE_JPEG_QUALITY, 95])


def in_child(folder: str, source: Path) -> dict[str, Any]:
    """What :func:`extracted` gives with the package in a source folder; the second time, with its kernels cached."""
    environment = os.environ | {"PYTHONPATH": f"{source}:{Path(__file__).resolve().parent}"}
    with tempfile.TemporaryDirectory() as cache:
        environment["NUMBA_CACHE_DIR"] = cache
        for _ in range(2):
            command = [sys.executable, __file__, "--extract", folder]
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def extracted(folder: str) -> dict[str, Any]:
    """Peak memory, CPU seconds and the digest of features."""
    import sfmapp
    from sfmapp.features.extract import compile_kernels

    compile_kernels()
    images = sfmapp.load_images(folder)
    start = time.process_time()
    features = sfmapp.extract_features(images, threads=NUM_WORKERS)
    digest = hashlib.sha256(b"".join(f.keypoints.tobytes() + f.descriptors.tobytes() for f in features))
    return {
        "cpu_s": round(time.process_time() - start, 2),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6),
        "digest": digest.hexdigest()[:16],
    }


def table(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [
        "# Memory", "",
        f"{report['date']}, {report['commit']}, {report['cpu']}. {NUM_PICTURES} pictures, peak of the process.", "",
        "| case | peak, MB | may be | before | CPU s | before | same bytes |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["rows"]:
        same = "yes" if row["digest"] == row.get("before_digest") else "NO" if "before_digest" in row else ""
        lines.append(
            f"| {row['case']} | {row['peak_mb']} | {row['most_mb']:.0f} | {row.get('before_peak_mb', '')} | "
            f"{row['cpu_s']} | {row.get('before_cpu_s', '')} | {same} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
