"""Every claim of the project as a row with a verdict, from the committed results: ahead, level or behind.

    python benchmarks/verdicts.py                    # writes results/baseline.json and results/verdicts.md
    python benchmarks/verdicts.py --compare FOLDER   # what other results, measured anew, change in the baseline

Nothing is measured here. Level are costs and errors within a tenth, which is about what a shared machine changes in a
measurement, scores within one percentage point, and counts that are equal. No row is left out because it is lost.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

RESULTS = Path(__file__).resolve().parent / "results"
# below these, differences are noise: of costs and errors as a share, of scores in percentage points, of pictures in dB
SHARE, POINTS, DECIBELS = 0.1, 1.0, 0.25
SPARSE = (
    ("model.num_registered", "registered images", "count", "more"),
    ("wall_s", "wall time", "s", "less"),
    ("cpu_s", "CPU time", "s", "less"),
    ("peak_memory_mb", "peak memory", "MB", "less"),
    ("ground_truth.center_error.mean", "mean error of camera centres", "unit of the ground truth", "less"),
    ("ground_truth.rotation_error_deg.mean", "mean rotation error", "deg", "less"),
    ("ground_truth.auc.1", "AUC@1", "%", "more"),
    ("ground_truth.auc.5", "AUC@5", "%", "more"),
)

SURVEYED = ("horizontal", "vertical", "scale", "rotation", "mean")


@dataclass(frozen=True)
class Row:
    """A figure of ours, beside that of a peer where there is one.

    Attributes:
        benchmark: whose results it comes from, ``results/BENCHMARK.json``.
        case: data set or problem.
        quantity, unit, better: what is compared, and which way.
        sfmapp, peer_value: the figures; peer: the other program, empty where none was measured.
        is_published: the peer's figure is from its authors or our research note, measured on another machine.
        date, commit: of our figure.
    """

    benchmark: str
    case: str
    quantity: str
    unit: str
    better: Literal["less", "more"]
    sfmapp: float
    peer: str
    peer_value: float | None
    is_published: bool
    date: str
    commit: str

    @property
    def verdict(self) -> str:
        """``ahead``, ``level`` or ``behind`` of the peer; ``alone`` without one."""
        if self.peer_value is None:
            return "alone"
        if is_level(self.sfmapp, self.peer_value, self.unit):
            return "level"
        return "ahead" if (self.sfmapp < self.peer_value) == (self.better == "less") else "behind"


def is_level(a: float, b: float, unit: str) -> bool:
    """Whether two figures of a unit differ by no more than noise."""
    margin = {"%": POINTS, "count": 0.0, "dB": DECIBELS}.get(unit, SHARE * max(abs(a), abs(b)))
    return abs(a - b) <= margin


def read(folder: Path, benchmark: str) -> dict[str, Any]:
    """The committed results of a benchmark."""
    report: dict[str, Any] = json.loads((folder / f"{benchmark}.json").read_text(encoding="utf-8"))
    return report


def rows_of(folder: Path) -> list[Row]:
    """All rows, benchmark by benchmark, of those whose results are there."""
    makers = {
        "sparse": sparse_rows,
        "sparse_peers": sparse_peer_rows,
        "bundle_adjustment": adjustment_rows,
        "large_adjustment": large_adjustment_rows,
        "town": town_rows,
        "dense": dense_rows,
        "odometry": odometry_rows,
        "handheld": handheld_rows,
        "calibration": calibration_rows,
        "two_views": two_view_rows,
        "known_points": known_point_rows,
        "rigs": rig_rows,
        "stereo_rectification": rectification_rows,
        "panorama": panorama_rows,
        "tagged_sets": tagged_rows,
        "circle_centers": circle_rows,
        "uncalibrated": uncalibrated_rows,
        "planes": plane_rows,
        "stereo": stereo_rows,
        "stereo_exposure": exposure_rows,
        "stereo_zncc": zncc_rows,
        "dense_pairs": pair_rows,
        "carving": carving_rows,
        "carving_joined": joined_rows,
        "carving_tolerance": tolerance_rows,
        "carving_wrong_views": wrong_view_rows,
        "voxel_coloring": color_rows,
        "shadow_carving": shadow_rows,
        "masks": mask_rows,
        "masks_still": still_mask_rows,
        "matching": matching_rows,
        "memory": memory_rows,
        "cold_start": first_run_rows,
        "clusters": cluster_rows,
        "scale": scale_rows,
    }
    return [row for name, make in makers.items() if (folder / f"{name}.json").is_file() for row in make(folder)]


def memory_rows(folder: Path) -> Iterator[Row]:
    """Memory of SIFT beside the package before a window of rows moved over its octaves."""
    report = read(folder, "memory")
    about = (False, report["date"][:10], report["commit"])
    for row in report["rows"]:
        for key, what, unit in (("peak_mb", "peak memory", "MB"), ("cpu_s", "CPU time", "s")):
            yield Row("memory", row["case"], what, unit, "less", row[key], "f96fb8e", row.get(f"before_{key}"), *about)


def first_run_rows(folder: Path) -> Iterator[Row]:
    """What the first run of a command takes more than the second, which has its kernels."""
    report = read(folder, "cold_start")
    about = (False, report["date"][:10], report["commit"])
    for row in report["runs"]:
        what = "CPU time of the first run over that of the second"
        yield Row("cold_start", row["case"], what, "s", "less", row["more_cpu_s"], "", None, *about)


def cluster_rows(folder: Path) -> Iterator[Row]:
    """What workers of dask take more than threads of one process."""
    report = read(folder, "clusters")
    about = (False, report["date"][:10], report["commit"])
    threads = {row["case"]: row["cpu_s"] for row in report["rows"] if not row["workers"]}
    for row in report["rows"]:
        if row["workers"] and row["killed_at_step"] is None:
            case = f"{row['case']}, {row['workers']} local workers"
            ours, theirs = row["cpu_s"], threads[row["case"]]
            yield Row("clusters", case, "CPU time", "s", "less", ours, "threads of one process", theirs, *about)


def scale_rows(folder: Path) -> Iterator[Row]:
    """Large sets on many workers, simulated with measured costs."""
    report = read(folder, "scale")
    about = (False, report["date"][:10], report["commit"])
    for row in report["rows"]:
        case = f"{row['images']:,} photographs, {row['workers']} workers, on paper"
        hours = (row["features_s"] + row["pairs_s"] + row["matching_s"]) / 3600.0
        yield Row("scale", case, "wall time to verified matches", "h", "less", hours, "", None, *about)


def calibration_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp calibrate board`` against OpenCV."""
    report = read(folder, "calibration")
    about = (False, report["date"][:10], report["commit"])
    for row in report.get("photographs", []):
        case, theirs = f"chessboards, {row['camera']} camera", row["opencv_held_out_px_own_points"]
        ours = row["held_out_px"]
        yield Row("calibration", case, "rms of views held out", "px", "less", ours, "OpenCV", theirs, *about)
    for row in report.get("degraded", []):
        case = f"{row['board']}, {row['case']}"
        yield Row("calibration", case, "points found", "count", "more", row["found"], "OpenCV", row["opencv"], *about)
    refined = report.get("refinement", [])
    for lens in dict.fromkeys(row["lens"] for row in refined):
        mine = [row for row in refined if row["lens"] == lens]
        for key, start in (("cpu_ms", "the same guess"), ("from_nothing_cpu_ms", "nothing")):
            ours, theirs = (1e-3 * sum(row[one] for row in mine) for one in (key, f"opencv_{key}"))
            case = f"rational model, lens of {lens}, from {start}, {len(mine)} sets of 30 views"
            yield Row("calibration", case, "CPU time", "s", "less", ours, "OpenCV", theirs, *about)
    whole = {row["program"]: row for row in report.get("photographs_12_mp", [])}
    for program, row in whole.items():
        if program.startswith("OpenCV"):
            for key, what, unit in (
                ("wall_s", "wall time", "s"), ("cpu_s", "CPU time", "s"), ("peak_mb", "peak memory", "MB"),
                ("projection_error_px", "projection error", "px"),
            ):  # fmt: skip
                ours, theirs = whole["sfmapp"][key], row[key]
                yield Row("calibration", "30 photographs of 12 MP", what, unit, "less", ours, program, theirs, *about)


def two_view_rows(folder: Path) -> Iterator[Row]:
    """Robust estimators against OpenCV's USAC, pycolmap and PoseLib: refined on photographs, those of the main path
    where CPU time is compared."""
    report = read(folder, "two_views")
    about = (False, report["date"][:10], report["commit"])
    peers = ("OpenCV", "pycolmap", "PoseLib")
    for case, row in report["medians"].items():
        for peer in peers:
            ours = row["F sfmapp, refined"], row["E sfmapp"]
            for what, value in zip(("F", "E"), ours, strict=True):
                quantity = f"{what}, distance of exact points"
                yield Row("two_views", case, quantity, "px", "less", value, peer, row[f"{what} {peer}"], *about)
    graf = report["graf"]
    for peer in peers:
        yield Row("two_views", "graf", "H", "px", "less", graf["sfmapp, refined"], peer, graf[peer], *about)
    speed = {(row["what"], row["program"]): row for row in report["speed"]}
    for (what, program), row in speed.items():
        if program in peers:
            mine = speed[what, "sfmapp"]
            for quantity, unit, key in (
                ("CPU time", "ms", "cpu_ms"), ("typical error", row["unit"], "typical_error")
            ):  # fmt: skip
                case = f"{what}, 1,000 matches, half wrong"
                yield Row("two_views", case, quantity, unit, "less", mine[key], program, row[key], *about)


def panorama_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp panorama`` against OpenCV's Stitcher and Hugin."""
    report = read(folder, "panorama")
    about = (False, report["date"][:10], report["commit"])
    runs = {(run["set"], run["program"]): run for run in report["runs"]}
    for (case, program), peer in runs.items():
        if program == "sfmapp":
            continue
        ours = runs[case, "sfmapp"]
        for quantity, unit, key in (
            ("worst rotation", "deg", "rotation_deg"), ("focal length", "%", "focal_percent"),
            ("where neighbours meet, rms", "px", "seam_rms_px"), ("CPU time", "s", "cpu_s"),
        ):  # fmt: skip
            if key in peer:  # a program that joins nothing has no error
                yield Row("panorama", case, quantity, unit, "less", ours[key], program, peer[key], *about)


def stereo_rows(folder: Path) -> Iterator[Row]:
    """Our matchers of rectified pairs against the best of each peer's settings, quantity by quantity."""
    report = read(folder, "stereo")
    about = (False, report["date"][:10], report["commit"])
    quantities: tuple[tuple[str, str, Literal["less", "more"], str], ...] = (
        ("bad-1 of answers", "%", "less", "bad1_answered_visible"),
        ("bad-2 of answers", "%", "less", "bad2_answered_visible"),
        ("mean error of answers", "px", "less", "mean_answered_visible"),
        ("density", "%", "more", "density_visible"),
        ("bad-1 of all pixels, holes filled", "%", "less", "bad1_complete_all"),
        ("mean error of all pixels, holes filled", "px", "less", "mean_complete_all"),
        ("mean error of all pixels that were searched, holes filled", "px", "less", "mean_searched_all"),
        ("bad-1 of all pixels, in whole pixels as the truth", "%", "less", "bad1_whole_all"),
        ("CPU time", "ms", "less", "cpu_ms"),
    )
    for name in dict.fromkeys(run["set"] for run in report["runs"]):
        runs = {run["matcher"]: run for run in report["runs"] if run["set"] == name}
        for mine, peer in (("sfmapp window", "StereoBM"), ("sfmapp", "StereoSGBM"), ("sfmapp", "ELAS"),
                           ("sfmapp", "pandora")):  # fmt: skip
            # defaults of StereoSGBM have no penalties: quick, and wrong
            others = [run for key, run in runs.items() if key.startswith(peer) and key != "StereoSGBM, defaults"]
            for quantity, unit, better, key in quantities:
                told = [run[key] for run in others if key in run]
                if not told or (key == "mean_searched_all" and others[0].get("searched_all", 100.0) > 99.9):
                    continue
                # whole maps are filled by whoever fills them; what a matcher leaves open, by KITTI's development kit
                own = runs[f"{mine}, filled" if key.endswith("_all") else mine][key]
                case = f"{name}, {'windows' if mine.endswith('window') else 'semi-global'}"
                best = (min if better == "less" else max)(told)
                yield Row("stereo", case, quantity, unit, better, own, peer, best, *about)


def exposure_rows(folder: Path) -> Iterator[Row]:
    """Semi-global matching of pairs that are exposed differently, against StereoSGBM."""
    report = read(folder, "stereo_exposure")
    about = (False, report["date"][:10], report["commit"])
    runs = {(run["set"], run["change"], run["matcher"]): run for run in report["runs"]}
    for name, change in dict.fromkeys((run["set"], run["change"]) for run in report["runs"]):
        own, peer = (runs[name, change, matcher]["none_or_bad1"] for matcher in ("sfmapp", "StereoSGBM"))
        case = f"{name}, right picture: {change}"
        yield Row("stereo_exposure", case, "none or bad-1", "%", "less", own, "StereoSGBM", peer, *about)


def zncc_rows(folder: Path) -> Iterator[Row]:
    """Semi-global matching on census against the same on ZNCC, of the windows that serve it best."""
    report = read(folder, "stereo_zncc")
    about = (False, report["date"][:10], report["commit"])
    costs: dict[str, dict[int, float]] = {}
    for run in report["runs"]:
        costs.setdefault(run["set"], {})[run["side"]] = run["bad1_answered_visible"]
    for name, of_side in costs.items():
        zncc = min(value for side, value in of_side.items() if side)
        yield Row("stereo_zncc", name, "bad-1 of answers", "%", "less", of_side[0], "ZNCC as the cost", zncc, *about)


def circle_rows(folder: Path) -> Iterator[Row]:
    """Focal lengths from tilted circles whose centres are corrected, against OpenCV's centres of mass."""
    report = read(folder, "circle_centers")
    about = (False, report["date"][:10], report["commit"])
    for tilt in sorted({row["tilt_deg"] for row in report["rows"]}):
        of_tilt = [row for row in report["rows"] if row["tilt_deg"] == tilt]
        ours = [row["focal_error_px"] for row in of_tilt if row["centers"] == "by the camera"]
        theirs = [row["opencv_focal_error_px"] for row in of_tilt if row.get("opencv_focal_error_px") is not None]
        own, peer = (math.sqrt(sum(error**2 for error in part) / len(part)) for part in (ours, theirs))
        case = f"circles tilted by {tilt:g} degrees"
        yield Row("circle_centers", case, "focal length, rms error", "px", "less", own, "OpenCV", peer, *about)


def tagged_rows(folder: Path) -> Iterator[Row]:
    """Photographs with positions in their tags against pycolmap's mapper with position priors."""
    report = read(folder, "tagged_sets")
    about = (False, report["date"][:10], report["commit"])
    runs = {(run["kind"], run["seed"], run["program"]): run for run in report["rows"]}
    for (kind, seed, program), peer in runs.items():
        if program == "sfmapp":
            continue
        ours, case = runs[kind, seed, "sfmapp"], f"{kind}, seed {seed}"
        for quantity, unit, key in (
            ("error of the scale", "share", "scale_error_share"), ("places of cameras, rms", "m", "rms_m"),
            ("CPU time", "s", "cpu_s"),
        ):  # fmt: skip
            yield Row("tagged_sets", case, quantity, unit, "less", abs(ours[key]), program, abs(peer[key]), *about)


def uncalibrated_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp uncalibrated`` and ``transfer``, against the truth alone."""
    report = read(folder, "uncalibrated")
    about = ("", None, False, report["date"][:10], report["commit"])
    dino = report["dinosaur"]
    for what, value in (
        ("five known points, rms of the rest, median", dino["five_points_percent"][0]),
        ("five known points, rms of the rest, 90 %", dino["five_points_percent"][1]),
        ("self-calibration, similarity to the reference", dino["similarity_percent"]),
        ("self-calibration, two open numbers freed", dino["two_numbers_freed_percent"]),
    ):
        yield Row("uncalibrated", "dinosaur", what, "%", "less", value, *about)
    peer, about = "reference P", about[2:]
    for key, what, unit in (
        ("step_rms_deg", "turntable's steps against ten degrees, rms", "deg"),
        ("radius_percent", "radius of the turntable's circle, rms", "%"),
        ("height_percent", "height of the turntable's circle, rms", "%"),
    ):
        ours, given = (dino[name][key] for name in ("turntable", "reference_turntable"))
        yield Row("uncalibrated", "dinosaur", what, unit, "less", ours, peer, given, *about)
    for row in report["transfers"]:
        if "refused" not in row:
            case = "courtyard, to " + row["triple"][2]
            yield Row(
                "uncalibrated", case, "transfer, median", "px", "less", row["tensor"]["median_px"], "", None, *about
            )


def matching_rows(folder: Path) -> Iterator[Row]:
    """The matching stage against itself at an earlier commit."""
    report = read(folder, "matching")
    about = (False, report["date"][:10], report["commit"])
    peer = f"sfmapp at {report['before']}"
    for row in report["sets"]:
        now, before = row["now"], row["before"]
        yield Row("matching", row["set"], "CPU time", "s", "less", now["cpu_s"], peer, before["cpu_s"], *about)
        pairs, pairs_before = len(now["pairs"]), len(before["pairs"])
        yield Row("matching", row["set"], "verified pairs", "count", "more", pairs, peer, pairs_before, *about)


def plane_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp warp`` and ``rectify`` against OpenCV's warpPerspective, in each of its ways."""
    report = read(folder, "planes")
    about = (False, report["date"][:10], report["commit"])
    ours = {row["case"]: row for row in report["sampling"] if row["program"] == "sfmapp"}
    for row in report["sampling"]:
        mine, peer = ours[row["case"]], row["program"]
        if peer != "sfmapp":
            for picture, rms in row["rms"].items():
                what = f"rms on {picture}"
                yield Row("planes", row["case"], what, "grey levels", "less", mine["rms"][picture], peer, rms, *about)
            yield Row("planes", row["case"], "CPU time", "ms", "less", mine["cpu_ms"], peer, row["cpu_ms"], *about)


def joined_rows(folder: Path) -> Iterator[Row]:
    """Silhouettes joined with patches, against each of them alone."""
    report = read(folder, "carving_joined")
    about = False, report["date"][:10], report["commit"]
    for case in dict.fromkeys(run["case"] for run in report["runs"]):
        runs = {run["way"]: run for run in report["runs"] if run["case"] == case}
        ours = runs["joined"]
        for way in ("hull", "patches", "mesh of patches"):
            mine, theirs = (100.0 * run["at 0.01"]["f"] for run in (ours, runs[way]))
            yield Row("carving_joined", case, "F-score at 1 % of the size", "%", "more", mine, way, theirs, *about)
            if (part := "of it, by patches or outlines") in runs:
                told = 100.0 * runs[part]["at 0.01"]["f"]
                what = "F-score at 1 % of the size, what patches or outlines tell"
                yield Row("carving_joined", case, what, "%", "more", told, way, theirs, *about)
        if "volume_error" in ours:
            mine, theirs = (100.0 * abs(runs[way]["volume_error"]) for way in ("joined", "hull"))
            yield Row("carving_joined", case, "error of the volume", "%", "less", mine, "hull", theirs, *about)


def color_rows(folder: Path) -> Iterator[Row]:
    """Carving by colours against the coloured hull, drawn alike, and both against what was asked for."""
    report = read(folder, "voxel_coloring")
    about = False, report["date"][:10], report["commit"]
    hulls = {(run["case"], run["drawn"]): run for run in report["runs"] if run["way"] == "hull"}
    for run in report["runs"]:
        hull = hulls[run["case"], run["drawn"]]
        if run is hull:
            continue
        benchmark, case = "voxel_coloring", f"{run['case']}, {run['way']}, {run['drawn']}"
        yield Row(
            benchmark, case, "PSNR of unused photographs", "dB", "more", run["psnr"], "coloured hull", hull["psnr"],
            *about,
        )  # fmt: skip
        if "volume_error" in run:
            mine, theirs = (100.0 * abs(each["volume_error"]) for each in (run, hull))
            yield Row(benchmark, case, "error of the volume", "%", "less", mine, "hull", theirs, *about)


def shadow_rows(folder: Path) -> Iterator[Row]:
    """Carving by silhouettes and shadows against silhouettes alone."""
    report = read(folder, "shadow_carving")
    about = False, report["date"][:10], report["commit"]
    for run in report["rows"]:
        told = f", edges of {run['edges']} deg told" if run["edges"] else ""
        case = (
            f"{run['scene']}, {run['density']} at {run['lamps']} deg{told}, {run['cells']} cells, noise {run['seed']}"
        )
        mine, theirs = run["error_percent"], run["hull_error_percent"]
        yield Row("shadow_carving", case, "error of the volume", "%", "less", mine, "hull", theirs, *about)


def carving_rows(folder: Path) -> Iterator[Row]:
    """Space carving against dense grids."""
    report = read(folder, "carving")
    about = (False, report["date"][:10], report["commit"])
    grid = report["grid"]
    for case, what, unit, figures in (
        (f"dinosaur, {grid['cells']} cells", "CPU time", "s", grid["cpu_s"]),
        (f"dinosaur, {grid['fine_cells']} cells", "memory of the cells", "MB", grid["fine_mb"]),
    ):
        for peer, value in figures.items():
            if peer != "sfmapp":
                yield Row("carving", case, what, unit, "less", figures["sfmapp"], peer, value, *about)
    for run in report["dinosaur"]:
        case = f"dinosaur, {run['cells']} cells, whole"
        yield Row("carving", case, "CPU time", "s", "less", run["cpu_s"], "", None, *about)
        yield Row("carving", case, "peak memory", "MB", "less", run["peak_mb"], "", None, *about)
    for run in report["bunny"]["runs"]:
        case = f"bunny, {run['cells']} cells"
        yield Row("carving", case, "IoU of silhouettes, least", "%", "more", 100.0 * min(run["iou"]), "", None, *about)


def tolerance_rows(folder: Path) -> Iterator[Row]:
    """Silhouettes with holes and spills, and clean ones that are treated alike, against strict carving."""
    report = read(folder, "carving_tolerance")
    about = (False, report["date"][:10], report["commit"])
    for case, kind in dict.fromkeys((row["case"], row["kind"]) for row in report["rows"]):
        mine = [row for row in report["rows"] if (row["case"], row["kind"]) == (case, kind)]
        label = f"{case}, {mine[0]['views']} views{', rules made on it' if mine[0]['made_on'] else ''}"
        ours, strict = (100.0 * min(row[how] for row in mine) for how in ("tolerant", "strict"))
        what = f"masks with {kind}s, IoU with the clean hull, least"
        yield Row("carving_tolerance", label, what, "%", "more", ours, "strict carving", strict, *about)
        if kind == "hole":
            what, clean = "clean masks, IoU with the clean hull", 100.0 * mine[0]["clean"]
            yield Row("carving_tolerance", label, what, "%", "more", clean, "strict carving", 100.0, *about)


def wrong_view_rows(folder: Path) -> Iterator[Row]:
    """One view that is wrong among others: whether it is named, and no other."""
    report = read(folder, "carving_wrong_views")
    about = (False, report["date"][:10], report["commit"])
    for kind in dict.fromkeys(row["kind"] for row in report["rows"]):
        mine = [row for row in report["rows"] if row["kind"] == kind]
        named = 100.0 * sum(row["named"] for row in mine) / len(mine)
        yield Row("carving_wrong_views", kind, f"named, of {len(mine)}", "%", "more", named, "", None, *about)
        others = sum(row["wrongly_named"] for row in mine)
        yield Row("carving_wrong_views", kind, "others named", "count", "less", others, "", None, *about)


def mask_rows(folder: Path) -> Iterator[Row]:
    """Silhouettes by shared colours against GrabCut, which is told where the object is."""
    report = read(folder, "masks")
    about, peer = (False, report["date"][:10], report["commit"]), "GrabCut with the true rectangle"
    for row in report["rows"]:
        yield Row("masks", row["case"], "IoU", "%", "more", 100 * row["iou"], peer, 100 * row["peer_iou"], *about)
        yield Row("masks", row["case"], "CPU time", "ms", "less", row["cpu_ms"], peer, row["peer_cpu_ms"], *about)


def still_mask_rows(folder: Path) -> Iterator[Row]:
    """Silhouettes before a background that stands still against GrabCut, which is told where the object is."""
    report = read(folder, "masks_still")
    about, peer = (False, report["date"][:10], report["commit"]), "GrabCut with the true rectangle"
    for row in report["rows"]:
        for how in ("told nothing", "given the background"):
            if how in row:
                what, ours = f"IoU, {how}", 100 * row[how]["iou"]
                yield Row("masks_still", row["case"], what, "%", "more", ours, peer, 100 * row["peer"], *about)


def known_point_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp calibrate target`` and ``locate`` against OpenCV and pycolmap."""
    report = read(folder, "known_points")
    about = (False, report["date"][:10], report["commit"])
    for kind, error, unit in (("cameras", "focal_rms_px", "px"), ("poses", "rotation_rms_deg", "deg")):
        ours = {row["case"]: row for row in report[kind] if row["program"] == "sfmapp"}
        what = "rms error of focal lengths" if kind == "cameras" else "rms error of rotations"
        for row in report[kind]:
            mine, peer = ours[row["case"]], row["program"].partition(",")[0]
            if row is mine:
                continue
            case = f"{row['case']}, {row['program']}"
            yield Row("known_points", case, what, unit, "less", mine[error], peer, row[error], *about)
            yield Row("known_points", case, "CPU time", "ms", "less", mine["cpu_ms"], peer, row["cpu_ms"], *about)
            if kind == "poses" and mine["gross"] + row["gross"]:
                grosses = mine["gross"], peer, row["gross"]
                yield Row("known_points", case, "grossly wrong poses", "count", "less", *grosses, *about)


def rig_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp calibrate rig`` against OpenCV, on the pairs of its samples."""
    report = read(folder, "rigs")
    rms = report["opencv"]["epipolar_rms_px"]["all"]
    case, text = f"{report['opencv']['pairs']} pairs of chessboards", "epipolar rms"
    yield Row(
        "rigs", case, text, "px", "less", rms["sfmapp"], "OpenCV", rms["OpenCV"], False, report["date"][:10],
        report["commit"],
    )  # fmt: skip


def rectification_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp stereo`` against cv2.stereoRectify: vertical parallax of rectified pairs."""
    report = read(folder, "stereo_rectification")
    about = ("OpenCV", report["date"][:10], report["commit"])
    rows = {
        f"{len(report['fountain'])} pairs of fountain-P11": report["fountain"],
        "13 pairs of chessboards": [report["boards"]],
        f"{len(report['rendered'])} converging pairs of two lenses": report["rendered"],
    }
    for case, found in rows.items():
        ours, theirs = (math.sqrt(sum(row[name] ** 2 for row in found) / len(found)) for name in ("sfmapp", "OpenCV"))
        yield Row(
            "stereo_rectification", case, "vertical parallax, rms", "px", "less", ours, about[0], theirs, False,
            *about[1:],
        )  # fmt: skip


def pair_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp dense`` of two photographs, beside what it was: patches that grow, alone."""
    report = read(folder, "dense_pairs")
    for row in report["pairs"]:
        ours, theirs = (100.0 * row[way]["right"] for way in ("both", "growth"))
        yield Row(
            "dense_pairs", row["pair"], "right within a pixel of disparity", "%", "more", ours, "growth alone", theirs,
            False, report["date"][:10], report["commit"],
        )  # fmt: skip


def sparse_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp reconstruct`` against pycolmap."""
    yield from _rows_against(read(folder, "sparse"), "sparse", ("pycolmap",), SPARSE)


def sparse_peer_rows(folder: Path) -> Iterator[Row]:
    """The same against pycolmap's global mapper and openmvg-rs, without wall times: the machine had other work."""
    quantities = tuple(row for row in SPARSE if row[0] != "wall_s")
    report = read(folder, "sparse_peers")
    yield from _rows_against(report, "sparse_peers", ("pycolmap global", "openmvg-rs"), quantities)


def _rows_against(
    report: dict[str, Any], benchmark: str, peers: tuple[str, ...], quantities: tuple[tuple[str, ...], ...]
) -> Iterator[Row]:
    for (case, programs), peer in product(report["medians"].items(), peers):
        for path, quantity, unit, better in quantities:
            ours, theirs = (programs.get(program, {}).get(path) for program in ("sfmapp", peer))
            if unit == "%":
                ours, theirs = (None if value is None else 100 * value for value in (ours, theirs))
            if ours is not None:
                yield Row(
                    benchmark, case, quantity, unit, better, ours, peer, theirs, False, report["date"][:10],
                    report["commit"],
                )  # type: ignore[arg-type]  # fmt: skip


def adjustment_rows(folder: Path) -> Iterator[Row]:
    """Bundle adjustment against Ceres."""
    report = read(folder, "bundle_adjustment")
    for row in report["rows"]:
        yield Row(
            "bundle_adjustment", f"{row['model']}, {row['loss']} loss", "CPU time", "s", "less", row["sfmapp"]["cpu_s"],
            "Ceres", row["ceres"]["cpu_s"], False, report["date"][:10], report["commit"],
        )  # fmt: skip


def large_adjustment_rows(folder: Path) -> Iterator[Row]:
    """Large adjustments against an earlier commit, and against Ceres."""
    report = read(folder, "large_adjustment")
    about = (False, report["date"][:10], report["commit"])
    for row in report["rows"]:
        ours = [r for r in report["rows"] if r["set"] == row["set"] and r["program"] == "sfmapp" and r["threads"] == 1]
        if row["program"] not in ("before", "ceres") or not ours:
            continue
        peer = "Ceres" if row["program"] == "ceres" else f"sfmapp at {report['before']}"
        for key, quantity, unit in (
            ("step_cpu_s", "CPU time of a step", "s"), ("cpu_s", "CPU time to the minimum", "s"),
            ("cost", "cost at the minimum", "px^2"), ("peak_mb", "peak memory", "MB"),
        ):  # fmt: skip
            yield Row("large_adjustment", row["set"], quantity, unit, "less", ours[0][key], peer, row[key], *about)


def town_rows(folder: Path) -> Iterator[Row]:
    """Mapping of a rendered town, beside pycolmap's from the same database."""
    report = read(folder, "town")
    about = (False, report["date"][:10], report["commit"])

    def size(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["part"], row["width"], row["views"]

    def figures(row: dict[str, Any]) -> list[float]:
        return [row["registered"], row["cpu_s"]["mapping"] / row["views"], row["ate_share"]]

    whats = (
        ("registered views", "count", "more"), ("CPU time of mapping, a view", "s", "less"),
        ("rms of centres, in sizes of the walk", "share", "less"),
    )  # fmt: skip
    peers = {size(row): figures(row) for row in report["rows"] if row["program"] == "pycolmap"}
    for row in report["rows"]:
        if row["program"] == "pycolmap":
            continue
        case, theirs = f"{row['views']} {row['part']} of {row['width']} px", peers.get(size(row))
        for k, (ours, what) in enumerate(zip(figures(row), whats, strict=True)):
            yield Row("town", case, *what, ours, "pycolmap" if theirs else "", theirs[k] if theirs else None, *about)


def dense_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp dense`` against the prototype, and against published figures of PMVS2 and OpenMVS."""
    report = read(folder, "dense")
    ours = {run["case"]: run for run in report["runs"] if run["program"] == "sfmapp" and run["threads"] == 1}
    peers = [
        (run["case"], run["program"], *_dense_figures(run), False) for run in report["runs"] if run not in ours.values()
    ]
    for case, programs in report["published"].items():
        for program, figures in programs.items():
            peers.append((case, program, figures["cpu_s"], figures["f_scores"], True))
    for case, program, cpu_s, f_scores, is_published in peers:
        run = ours.get(case)
        if run is None or program == "sfmapp":
            continue
        about = ("dense", case), (program,), (is_published, run["date"][:10], run["commit"])
        my_cpu_s, mine = _dense_figures(run)
        if cpu_s is not None:
            yield Row(*about[0], "CPU time", "s", "less", my_cpu_s, *about[1], cpu_s, *about[2])
        for place, (my_f, f) in enumerate(zip(mine or (), f_scores or (), strict=False)):
            yield Row(*about[0], f"F-score, distance {place + 1}", "%", "more", my_f, *about[1], f, *about[2])


def _dense_figures(run: dict[str, Any]) -> tuple[float, list[float] | None]:
    """CPU seconds, and F-scores in per cent at growing distances."""
    score = run.get("score")
    return run["cpu_s"], None if score is None else [100 * row["f_score"] for row in score["scores"]]


def odometry_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp odometry``: no peer has been run on the same frames on this machine."""
    report = read(folder, "odometry")
    for row in report["rows"]:
        figures = (
            ("frames in the largest map", "%", "more", 100 * row["num_in_largest_map"] / row["num_frames"]),
            ("ATE, rmse", "m", "less", row["ground_truth"]["ate_m"]["rmse"]),
            ("CPU time a frame", "ms", "less", row["cpu_ms_per_frame"]),
        )
        for quantity, unit, better, value in figures:
            yield Row(
                "odometry", row["case"], quantity, unit, better, value, "", None, False, report["date"][:10],
                report["commit"],
            )  # type: ignore[arg-type]  # fmt: skip


def handheld_rows(folder: Path) -> Iterator[Row]:
    """``sfmapp odometry`` beside ORB-SLAM3 on hand-held sequences of a rendered room."""
    report = read(folder, "handheld")
    theirs = {row["case"]: row for row in report["rows"] if row["program"] != "sfmapp"}

    def figures(row: dict[str, Any] | None) -> tuple[float | None, float | None, float | None]:
        if row is None:
            return None, None, None
        truth = row["ground_truth"]
        ate = None if truth is None else 1000 * truth["ate_m"]["rmse"]
        return 100 * row["num_in_largest_map"] / row["num_frames"], ate, row["process_cpu_ms_per_frame"]

    for row in report["rows"]:
        if row["program"] != "sfmapp":
            continue
        peer = theirs.get(row["case"])
        named = (("frames with a pose", "%", "more"), ("ATE, rmse", "mm", "less"), ("CPU time a frame", "ms", "less"))
        for (quantity, unit, better), value, other in zip(named, figures(row), figures(peer), strict=True):
            assert value is not None
            yield Row(
                "handheld", row["case"], quantity, unit, better, value, "" if peer is None else "ORB-SLAM3", other,
                False, report["date"][:10], report["commit"],
            )  # type: ignore[arg-type]  # fmt: skip


@dataclass(frozen=True)
class Promise:
    """Something that sfmapp says of itself, and how often it held."""

    benchmark: str
    text: str
    held: int
    tried: int
    date: str


def video_promises(folder: Path) -> Iterator[Promise]:
    """What is asked of frames that are chosen of videos, beside as many at equal distances, and beside pycolmap."""
    report = read(folder, "video")
    date, rows = report["date"][:10], {(row["film"], row["how"], row["who"]): row for row in report["rows"]}
    films = [film for film, how, who in rows if (how, who) == ("chosen", "sfmapp")]
    chosen = {film: rows[film, "chosen", "sfmapp"] for film in films}
    text = "of frames chosen of a video, 98 % are registered in one model"
    held = [row.get("registered", 0) >= 0.98 * row["num"] for row in chosen.values()]
    yield Promise("video", text, sum(held), len(held), date)
    for (how, who), what in {
        ("every n-th", "sfmapp"): "as many frames at equal distances",
        ("chosen", "pycolmap"): "pycolmap on the same frames",
    }.items():
        pairs = [(chosen[film], rows[film, how, who]) for film in films if (film, how, who) in rows]
        text = f"frames chosen of a video: no fewer are registered than of {what}"
        held = [row.get("registered", 0) >= other.get("registered", 0) for row, other in pairs]
        yield Promise("video", text, sum(held), len(held), date)
        both = [(row, other) for row, other in pairs if "failed" not in row and "failed" not in other]
        text = f"frames chosen of a video: centres are no farther off than of {what}"
        held = [row["center_share"] <= other["center_share"] for row, other in both]
        yield Promise("video", text, sum(held), len(held), date)


def planning_promises(folder: Path) -> Iterator[Promise]:
    """What is asked of plans, on sets that chose constants of the estimate and on those that did not."""
    report = read(folder, "planning")
    date = report["date"][:10]
    for has_chosen, whose in ((True, "sets that chose constants"), (False, "sets that chose nothing")):
        rows = [row for row in report["rows"] if row["has_chosen"] == has_chosen]
        for quantity, what in (("cpu_s", "CPU time"), ("peak_mb", "memory"), ("disk_mb", "disk")):
            near = sum(abs(row[quantity]["ratio"] - 1.0) <= 0.25 for row in rows)
            text = f"{what} of a run is within 25 % of its plan, {whose}"
            yield Promise("planning", text, near, len(rows), date)
        inside = sum(row["cpu_s"]["is_within"] for row in rows)
        yield Promise("planning", f"CPU time of a run is inside of its interval, {whose}", inside, len(rows), date)
    quiet = [row for row in report["rows"] if row["load"] < 1.5]
    if quiet:
        near = sum(abs(row["wall_s"]["ratio"] - 1.0) <= 0.25 for row in quiet)
        text = "time of a run is within 25 % of its plan where nothing else was at work"
        yield Promise("planning", text, near, len(quiet), date)


def town_promises(folder: Path) -> Iterator[Promise]:
    """What is asked of a rendered town: views registered, centres right, and none dearer than those of a small one."""
    report = read(folder, "town")
    date, rows = report["date"][:10], [row for row in report["rows"] if row["program"] == "sfmapp"]
    held = [row["registered"] >= 0.98 * row["views"] for row in rows]
    yield Promise(
        "town", "98 % of the views of a rendered town are registered in one model", sum(held), len(rows), date
    )
    held = [row["ate_share"] <= 1e-3 for row in rows]
    yield Promise(
        "town", "centres are off by no more than 0.1 % of the size of the walk, rms", sum(held), len(rows), date
    )
    few = {row["part"]: row["cpu_s"]["mapping"] / row["views"] for row in rows if row["views"] == 300}
    many = [row for row in rows if row["views"] > 300 and row["part"] in few]
    held = [row["cpu_s"]["mapping"] / row["views"] <= 1.5 * few[row["part"]] for row in many]
    text = "mapping of more than 300 views takes no more than 1.5 times the CPU time of a view at 300"
    if many:
        yield Promise("town", text, sum(held), len(held), date)


def promises(folder: Path) -> Iterator[Promise]:
    """What is promised, with the runs that break it."""
    wrong = read(folder, "wrong_inputs")
    runs = wrong["runs"]
    silent = sum(run["verdict"] == "SURE AND WRONG" for run in runs)
    narrow = sum(run["verdict"] == "said, but too sure" for run in runs)
    about = "wrong_inputs", len(runs), wrong["date"][:10]
    yield Promise(about[0], "a result that is wrong is red", about[1] - silent, *about[1:])
    yield Promise(about[0], "an error is within three stated sigmas", about[1] - silent - narrow, *about[1:])
    first = wrong["first_runs"]
    silent, narrow, num_runs = first["num_sure_and_wrong"], first["num_too_sure"], first["num_runs"]
    yield Promise(about[0], "the same on seeds never seen before: red", num_runs - silent, num_runs, about[2])
    yield Promise(about[0], "the same: within three sigmas", num_runs - silent - narrow, num_runs, about[2])
    report = read(folder, "self_calibration")
    found = [run for run in report["runs"] if not run["is_refused"]]
    within = sum(abs(run["error_percent"]) <= 2 * run["sigma_percent"] for run in found)
    text = "a self-calibrated focal length is within two stated sigmas"
    yield Promise("self_calibration", text, within, len(found), report["date"][:10])
    report = read(folder, "shadow_carving")
    runs = report["rows"]
    points, lost = (sum(run[name] for run in runs) for name in ("points", "points_lost"))
    about = "shadow_carving", report["date"][:10]
    yield Promise(about[0], "no true point of a surface is taken away by shadows", points - lost, points, about[1])
    for text, is_house in (("of the rendered house's hull", True), ("of hulls of other solids", False)):
        below = [run["below_hull_percent"] >= 30.0 for run in runs if (run["scene"] == "house") == is_house]
        yield Promise(about[0], f"shadows lower the error {text} by 30 %", sum(below), len(below), about[1])
    runs, date = read(folder, "cold_start")["runs"], read(folder, "cold_start")["date"][:10]
    text = "two cores work off what the first run of a command takes more in 15 s (demo 25 s)"
    yield Promise("cold_start", text, sum(row["more_cpu_s"] <= row["most_more_cpu_s"] for row in runs), len(runs), date)
    rows, date = read(folder, "clusters")["rows"], read(folder, "clusters")["date"][:10]
    text = "models by 1, 2 or 4 workers, one of them killed or none, are the bytes of threads"
    yield Promise("clusters", text, sum(row["is_same"] for row in rows), len(rows), date)
    rows, date = read(folder, "memory")["rows"], read(folder, "memory")["date"][:10]
    text = "SIFT on photographs of 6.8 megapixels takes less than 700 MB on two workers"
    yield Promise("memory", text, sum(row["peak_mb"] < row["most_mb"] for row in rows), len(rows), date)
    report = read(folder, "surveys")
    found, wrong = (sum(row[name] for row in report["rows"]) for name in ("found", "wrong"))
    yield Promise("surveys", "a grossly wrong position is found", found, wrong, report["date"][:10])
    for kind, what in (("all", "positions"), ("monument", "positions round a monument")):
        shares = [row[n] for row in report["rows"] if row["kind"] == kind for n in SURVEYED]
        text = f"95 % intervals of {what} hold 93 to 97 % of the truth"
        yield Promise("surveys", text, sum(93 <= share <= 97 for share in shares), len(shares), report["date"][:10])
    report = read(folder, "wrong_positions")
    rows = [row for part in ("fits", "stages") for row in report[part] if row["wrong"]]
    tried = sum(row[name] for row in rows for name in ("named", "red", "missed", "lost"))
    missed = sum(row["missed"] for row in rows)
    text = "grossly wrong positions, 4 to 30 with up to 40 % of them wrong: named, or red"
    yield Promise("wrong_positions", text, tried - missed, tried, report["date"][:10])
    rows = [row for part in ("fits", "stages") for row in report[part] if not row["wrong"]]
    tried, red = (sum(row[name] for row in rows for name in names) for names in (("named", "red", "lost"), ("red",)))
    yield Promise("wrong_positions", "right positions are not red", tried - red, tried, report["date"][:10])
    report = read(folder, "held_poses")
    said = [row["verdict"] != "silent" for row in report["rows"] if row["noise"] != "none"]
    text = "poses that are held and wrong, from 0.05 % and 0.02 degrees on: red, named or refused"
    yield Promise("held_poses", text, sum(said), len(said), report["date"][:10])
    silent = [row["verdict"] == "silent" for row in report["rows"] if row["noise"] == "none"]
    yield Promise("held_poses", "poses that are right: silent", sum(silent), len(silent), report["date"][:10])
    report = read(folder, "control_surveys")
    shares = [row[name] for row in report["rows"] for name in ("horizontal", "vertical")]
    text = "those of control points that were left out do"
    yield Promise("control_surveys", text, sum(93 <= share <= 97 for share in shares), len(shares), report["date"][:10])
    named, num = (sum(row[name] for row in report["rows"]) for name in ("named", "surveys"))
    text = "a control point that is wrong by a metre is named, and no other"
    yield Promise("control_surveys", text, named, num, report["date"][:10])
    report = read(folder, "inertial")
    scaled = [run["inertial"] for run in report["runs"] if run["inertial"].get("sigma") is not None]
    within = sum(abs(math.log(run["scale"])) < 3 * run["sigma"] for run in scaled)
    text = "a scale told by an IMU is within three stated sigmas"
    yield Promise("inertial", text, within, len(scaled), report["date"][:10])
    both = [(run["alone"], run["inertial"]) for run in report["runs"]]
    live = [[row["ate_live_mm"] for row in pair] for pair in both if all("ate_live_mm" in row for row in pair)]
    text = "poses given out live drift less with an IMU than without"
    yield Promise("inertial", text, sum(b < a for a, b in live), len(live), report["date"][:10])
    report = read(folder, "live")
    live = [run for run in report["runs"] if "live" in run]
    text = "a frame that a busy machine has no time for is counted: tracked and dropped ones are those that came"
    counted = [run["live"]["num_tracked"] + run["live"]["num_dropped"] == run["num_played"] for run in live]
    yield Promise("live", text, sum(counted), len(counted), report["date"][:10])
    text = "live, whatever the load: 95 % of the poses are known within 0.25 s"
    young = [run["live"]["latency_ms"]["p95"] < 250.0 for run in live]
    yield Promise("live", text, sum(young), len(young), report["date"][:10])
    text = "live, the last third of a run holds at most 20 MB more than the second"
    flat = [run["memory_mb"][2] - run["memory_mb"][1] <= 20.0 for run in live]
    yield Promise("live", text, sum(flat), len(flat), report["date"][:10])
    report = read(folder, "long_walk")
    settled = next(row["memory_mb"] for row in report["curve"] if row["frame"] >= 2000)
    text = "a walk of 10,000 frames holds at most 300 MB more in the end than at frame 2,000"
    yield Promise("long_walk", text, int(report["end_memory_mb"] - settled <= 300.0), 1, report["date"][:10])
    text = "all that comes after the last frame of 10,000 takes at most 60 CPU s"
    yield Promise("long_walk", text, int(report["end_cpu_s"] <= 60.0), 1, report["date"][:10])
    report = read(folder, "filtering")
    flown = [run for run in report["runs"] if "filter" in run]
    for name, of_what in (
        ("bounds", "independent innovations"),
        ("worth_bounds", "as many as those of others are worth"),
    ):
        text = f"live poses filtered with an IMU: NIS of a flight within the 95 % interval of {of_what}"
        told = [run["filter"][name][0] <= run["filter"]["nis"] <= run["filter"][name][1] for run in flown]
        yield Promise("filtering", text, sum(told), len(told), report["date"][:10])
    text = "live poses filtered with an IMU: innovations of a flight are white from frame to frame"
    white = [abs(run["filter"]["neighbours"]) <= run["filter"]["white"] for run in flown]
    yield Promise("filtering", text, sum(white), len(white), report["date"][:10])
    text = "live poses filtered with an IMU: a flight's ATE is below that of live poses"
    nearer = [run["ate_mm"]["filtered"] < run["ate_mm"]["live"] for run in flown]
    yield Promise("filtering", text, sum(nearer), len(nearer), report["date"][:10])
    text = "live poses filtered with an IMU: NEES of a flight below 2"
    stated = [run["filter"]["nees"] < 2.0 for run in flown]
    yield Promise("filtering", text, sum(stated), len(stated), report["date"][:10])
    text = "at the end of gaps of 0.5 to 3 s each of six errors is within three stated sigmas"
    bridged = [max(map(abs, gap["sigmas"])) < 3.0 for run in flown for gap in run["gaps"]]
    yield Promise("filtering", text, sum(bridged), len(bridged), report["date"][:10])
    report = read(folder, "wheeled")
    pairs = [(run["free"], run[motion]) for run in report["runs"] for motion in ("planar", "ackermann")]
    text = "on wheels planar motion gives no fewer frames a pose than free motion"
    kept = [planar["num_frames"] >= free["num_frames"] for free, planar in pairs]
    yield Promise("wheeled", text, sum(kept), len(kept), report["date"][:10])
    short = [(free, planar) for free, planar in pairs if free["num_frames"] < report["num_frames"]]
    text = "where free motion leaves frames without a pose, planar motion gives more of them one"
    more = [planar["num_frames"] > free["num_frames"] for free, planar in short]
    yield Promise("wheeled", text, sum(more), len(more), report["date"][:10])
    posed = [pair for pair in pairs if all("ate_m" in row for row in pair)]
    text = "on wheels planar motion has half the error of free motion"
    halved = [planar["ate_m"] <= 0.5 * free["ate_m"] for free, planar in posed]
    yield Promise("wheeled", text, sum(halved), len(halved), report["date"][:10])
    text = "on wheels, ramps and leaning cars among them, planar motion has a NEES below 2"
    honest = [planar["nees"] < 2.0 for _, planar in pairs if planar.get("nees") is not None]
    yield Promise("wheeled", text, sum(honest), len(honest), report["date"][:10])
    report = read(folder, "known_maps")
    rows, date = report["rows"], report["date"][:10]
    inside = [row for row in rows if row["expected"] == "in the map"]
    outside = [row for row in rows if row["expected"] != "in the map"]
    text = "a sequence in a known map is found there, loses no frame and agrees with it"
    good = [
        bool(row["known_map"].get("is_found"))
        and not row["contradicted"]
        and row["num_with_pose"] >= row["num_with_pose_alone"]
        for row in inside
    ]
    yield Promise("known_maps", text, sum(good), len(inside), date)
    again = [row for row in inside if "backwards" in row["case"]]
    text = "the same way once more in its map has a smaller error than the first run"
    yield Promise("known_maps", text, sum(row["ate_m"] < row["first_ate_m"] for row in again), len(again), date)
    text = "another place, or one that looks the same, is not taken for one of a known map"
    good = [not row["known_map"].get("is_found") for row in outside]
    yield Promise("known_maps", text, sum(good), len(outside), date)
    report = read(folder, "loops")
    rows, date = report["rows"], report["date"][:10]
    text = "no walk closes a loop to the like of a place, in halls of equal bays, rooms and blocks"
    yield Promise("loops", text, sum(row["with"]["num_wrong"] == 0 for row in rows), len(rows), date)
    text = "a walk that comes back to where it was closes a loop"
    yield Promise("loops", text, sum(row["with"]["num_right"] > 0 for row in rows), len(rows), date)
    report = read(folder, "losses")
    rows, date = report["rows"], report["date"][:10]
    text = "after a loss no frame is placed surely wrong, in halls of equal bays, rooms, blocks and kitti00-200"
    yield Promise("losses", text, sum(row["num_wrong"] == 0 for row in rows), len(rows), date)
    text = "most frames after a loss are in the map of before"
    yield Promise("losses", text, sum(2 * row["num_right"] > row["num_after"] for row in rows), len(rows), date)
    report = read(folder, "kidnapped")
    rows, date = [row for hall in report["halls"] for row in hall["rows"]], report["date"][:10]
    text = "a camera put down in a hall of look-alikes is where it is believed to be, or undecided; never surely wrong"
    yield Promise("kidnapped", text, sum(row["outcome"] != "surely wrong" for row in rows), len(rows), date)
    text = "put down before the corner that has no like it knows its place within 60 frames"
    before = [row["outcome"] == "right" for row in rows if row["kind"] == "towards the corner"]
    yield Promise("kidnapped", text, sum(before), len(before), date)
    report = read(folder, "locating")
    rows, date = report["sets"], report["date"][:10]
    text = "photographs left out of a set are located in the model of the rest"
    yield Promise("locating", text, sum(row["located"] for row in rows), sum(row["held_out"] for row in rows), date)
    text = "their centres are off by no more than half beyond those of all at once"
    good = [row["center_share"] <= 1.5 * row["center_share_all"] for row in rows]
    yield Promise("locating", text, sum(good), len(rows), date)
    text = "their NEES against exact and surveyed poses is between 0.5 and 2"
    yield Promise("locating", text, sum(0.5 <= row["nees"] <= 2.0 for row in rows), len(rows), date)
    for model in ("whole hall", "half of it"):
        rows = [row for hall in report["halls"] if hall["model"] == model for row in hall["rows"]]
        text = (
            f"a photograph in a hall of look-alikes, with a model of the {model}, is where it is said to be, or refused"
        )
        yield Promise("locating", text, sum(row["outcome"] != "wrong" for row in rows), len(rows), date)
    yield from video_promises(folder)
    report = read(folder, "adding")
    rows, date = [row for row in report["rows"] if "center_share" in row], report["date"][:10]

    def at_once(row: dict[str, Any], what: str) -> float:
        runs = [run for one in report["whole"] if one["case"] == row["case"] for run in one["runs"]]
        return sum(run[what] for run in runs) / len(runs)

    text = "photographs added in five batches: centres are off by no more than 5 % beyond those of all at once"
    good = [row["center_share"] <= 1.05 * at_once(row, "center_share") for row in rows]
    yield Promise("adding", text, sum(good), len(rows), date)
    text = "the same of rotations"
    good = [row["rotation_deg"] <= 1.05 * at_once(row, "rotation_deg") for row in rows]
    yield Promise("adding", text, sum(good), len(rows), date)
    text = "the same of how many photographs are registered"
    yield Promise("adding", text, sum(row["registered"] >= at_once(row, "registered") for row in rows), len(rows), date)
    yield from town_promises(folder)
    if (folder / "planning.json").is_file():
        yield from planning_promises(folder)
    report = read(folder, "odometry")
    same = [row["same_bytes"] for row in report["rows"]]
    yield Promise("odometry", "two runs write the same bytes", sum(same), len(same), report["date"][:10])
    report = read(folder, "lens_families")
    runs = report["runs"]
    whole = sum(run["num_registered"] == run["num_images"] and run["num_models"] == 1 for run in runs)
    yield Promise(
        "lens_families", "all images through a lens are registered in one model", whole, len(runs), report["date"][:10]
    )
    bends = [run["straight"]["bend_px"] for run in runs if run.get("straight")]
    text = "lines are straight to half a pixel in undistorted pictures"
    yield Promise("lens_families", text, sum(bend < 0.5 for bend in bends), len(runs), report["date"][:10])
    report = read(folder, "known_points")
    rows = [row for kind in ("cameras", "poses") for row in report[kind] if row.get("nees") is not None]
    good = sum(row["nees_low"] <= row["nees"] <= row["nees_high"] for row in rows)
    text = "sigmas from known points are those of the errors (NEES in its 99.8 %)"
    yield Promise("known_points", text, good, len(rows), report["date"][:10])
    report = read(folder, "line_photographs")
    told = [row for row in report["photographs"] if "focal_px" in row]
    right = sum(abs(row["focal_px"] - row["truth_px"]) <= 3.0 * row["sigma_px"] for row in told)
    text = "a focal length that lines of a real photograph tell is within three sigmas"
    yield Promise("line_photographs", text, right, len(told), report["date"][:10])
    report = read(folder, "rigs")
    rows, date = report["synthetic"], report["date"][:10]
    good = sum(0.9 <= row["nees"] <= 1.1 for row in rows)
    yield Promise("rigs", "sigmas of a rig are those of its errors (NEES 0.9 to 1.1)", good, len(rows), date)
    odd = report["odd"]
    yield Promise("rigs", "a board that moved between exposures is named", odd["moved"], odd["trials"], date)
    report = read(folder, "stereo_rectification")
    rows = report["turned"]
    good = sum(row.get("error_deg", math.inf) <= 0.005 for row in rows)
    text = "a rig that has turned by 0.05 degrees since its calibration is found to 0.005 degrees"
    yield Promise("stereo_rectification", text, good, len(rows), report["date"][:10])
    good = sum(row["depth_corrected"] <= 1.1 * row["depth_undisturbed"] for row in rows)
    text = "corrected, its depths are within 10 % of the error of a rig that has not turned"
    yield Promise("stereo_rectification", text, good, len(rows), report["date"][:10])
    report = read(folder, "stereo_sigma")
    rows = report["runs"]["Fitted on rendered pairs, judged on photographs"]
    good = sum(60 <= row["inside_68"] <= 76 and 92 <= row["inside_95"] <= 97 for row in rows)
    text = "intervals of 68 and 95 % of disparities hold 60 to 76 and 92 to 97 % of the errors on photographs"
    yield Promise("stereo_sigma", text, good, len(rows), report["date"][:10])
    report = read(folder, "stereo_filled_sigma")
    rows = report["runs"]["Photographs"]
    good = sum(60 <= row["inside_68"] <= 76 and 92 <= row["inside_95"] <= 97 for row in rows)
    yield Promise("stereo_filled_sigma", "the same of those that were filled in", good, len(rows), report["date"][:10])
    report = read(folder, "plane_sweep")
    rows, date = report["scores"], report["machine"]["date"][:10]
    confirmed = [row for row in rows if row["which"] == "confirmed"]
    good = sum(row["right_of_answered"] >= 0.9 for row in confirmed)
    text = "of the depths of a swept map that others confirm 90 % are within 1 %"
    yield Promise("plane_sweep", text, good, len(confirmed), date)
    textured = [row for row in rows if row["which"] == "answered" and not row["case"].startswith("lego")]
    good = sum(row["right_of_all"] >= 0.9 for row in textured)
    text = "of the textured pixels of a courtyard 90 % have a depth within 1 %"
    yield Promise("plane_sweep", text, good, len(textured), date)
    report = read(folder, "sweep_sigma")
    rows, date = [row for row in report["rows"] if row["map"] == "answered"], report["machine"]["date"][:10]
    good = sum(60 <= row["inside_68"] <= 76 and 92 <= row["inside_95"] <= 97 for row in rows)
    text = (
        "intervals of 68 and 95 % of swept depths hold 60 to 76 and 92 to 97 % of the errors on scenes of exact depth"
    )
    yield Promise("sweep_sigma", text, good, len(rows), date)
    rendered = [row for row in rows if not row["case"].startswith("lego")]
    good = sum(row["right_of_all"] >= 90 for row in rendered)
    yield Promise("sweep_sigma", "of textured pixels of rendered scenes 90 % are within 1 %", good, len(rendered), date)
    report = read(folder, "stereo_chance")
    for group, is_named, text in (
        ("true", False, "a pair that shows the same, however noisy, dark or plain, is not said to show something else"),
        ("unrelated", True, "a pair that does not show the same is named"),
    ):
        rows = report[group]
        good = sum(row["is_named"] == is_named for row in rows)
        yield Promise("stereo_chance", text, good, len(rows), report["date"][:10])
    report = read(folder, "calibration")
    rows, date = report["trials"], report["date"][:10]
    good = sum(0.9 <= row["nees"] <= 1.1 and row["projections_covered"] >= 0.93 for row in rows)
    yield Promise(
        "calibration", "sigmas of a calibration are those of its errors (NEES, coverage)", good, len(rows), date
    )
    good = sum(abs(row["trials_with_all_within_3_sigma"] - row["expected_of_right_sigmas"])
               <= 2.0 * row["sigma_of_that"] for row in rows)  # fmt: skip
    text = "all eight parameters are inside three sigmas as often as right sigmas have it (98.2 %)"
    yield Promise("calibration", text, good, len(rows), date)
    lenses = report.get("lenses", [])
    good, total = (sum(row[key] for row in lenses) for key in ("within_its_sigma", "sets"))
    text = "the lens model that is chosen is the true one, or nearer to it than its sigma"
    yield Promise("calibration", text, good, total, date)
    if films := [row for row in report.get("films", []) if row.get("nees") is not None and "model" in row]:
        text = "the camera of a filmed board is within two of its sigmas, in the mean over the picture"
        yield Promise("calibration", text, sum(row["error_sigmas"] < 2.0 for row in films), len(films), date)
    if taken := [*report.get("next", []), *report.get("next_points", [])]:
        good = sum(row["times_as_fast"] >= 2.0 for row in taken)
        text = "suggested views make projections sure twice as fast as others"
        yield Promise("calibration", text, good, len(taken), date)
    report = read(folder, "dense")
    digests = {run["digest"] for run in report["runs"] if run["case"] == "fountain" and "digest" in run}
    text = "one and two threads make the same patches"
    yield Promise("dense", text, int(len(digests) == 1), 1, report["date"][:10])


def markdown(folder: Path) -> str:
    """Both tables."""
    rows = rows_of(folder)
    compared = [row for row in rows if row.peer_value is not None]
    counts = ", ".join(f"{sum(r.verdict == v for r in compared)} {v}" for v in ("ahead", "level", "behind"))
    lines = [
        "# Verdicts",
        "",
        "Made by `python benchmarks/verdicts.py` from the results beside it; nothing here is written by hand.",
        f"{len(compared)} figures beside a peer's: {counts}. Level: costs and errors within a tenth,",
        "scores within one percentage point, counts that are equal. Alone: nobody else was measured on the same data.",
        "Figures marked * are published ones, measured by others on other machines.",
        "",
    ]
    for benchmark in dict.fromkeys(row.benchmark for row in rows):
        mine = [row for row in rows if row.benchmark == benchmark]
        dates = ", ".join(sorted({row.date for row in mine}))
        lines += [
            f"## {benchmark.replace('_', ' ')}",
            "",
            f"Measured {dates}; `results/{benchmark}.json`.",
            "",
            "| case | figure | sfmapp | peer | | verdict |",
            "|---|---|---|---|---|---|",
        ]
        for row in mine:
            peer = "" if row.peer_value is None else f"{row.peer_value:.4g}{'*' if row.is_published else ''}"
            figure = row.quantity if row.unit == "count" else f"{row.quantity}, {row.unit}"
            verdict = f"**{row.verdict}**" if row.verdict == "behind" else row.verdict
            lines.append(f"| {row.case} | {figure} | {row.sfmapp:.4g} | {peer} | {row.peer} | {verdict} |")
        lines.append("")
    lines += ["## Promises", "", "| promise | kept | of | measured | verdict |", "|---|---|---|---|---|"]
    for p in promises(folder):
        verdict = "kept" if p.held == p.tried else f"**broken {p.tried - p.held} times**"
        lines.append(f"| {p.text} (`results/{p.benchmark}.json`) | {p.held} | {p.tried} | {p.date} | {verdict} |")
    return "\n".join(lines) + "\n"


def baseline(folder: Path) -> str:
    """All rows as JSON, one a line."""
    rows = [json.dumps(asdict(row) | {"verdict": row.verdict}) for row in rows_of(folder)]
    return "[\n" + ",\n".join(rows) + "\n]\n"


def changes(folder: Path) -> Iterator[str]:
    """What results measured anew change in the committed baseline, beyond noise."""
    old = {
        (r["benchmark"], r["case"], r["quantity"], r["peer"]): r
        for r in json.loads((RESULTS / "baseline.json").read_text())
    }
    for row in rows_of(folder):
        before = old.get((row.benchmark, row.case, row.quantity, row.peer))
        if before is None:
            yield f"new: {row.benchmark}, {row.case}, {row.quantity}: {row.sfmapp:.4g}"
        elif not is_level(row.sfmapp, before["sfmapp"], row.unit):
            better = "better" if (row.sfmapp < before["sfmapp"]) == (row.better == "less") else "WORSE"
            yield f"{better}: {row.benchmark}, {row.case}, {row.quantity}: {before['sfmapp']:.4g} to {row.sfmapp:.4g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compare", type=Path, metavar="FOLDER", help="other results under the same names")
    args = parser.parse_args()
    if args.compare is not None:
        print("\n".join(changes(args.compare)) or "no figure differs by more than noise")
        return
    (RESULTS / "baseline.json").write_text(baseline(RESULTS), encoding="utf-8")
    (RESULTS / "verdicts.md").write_text(markdown(RESULTS), encoding="utf-8")
    print(markdown(RESULTS), end="")


if __name__ == "__main__":
    main()
