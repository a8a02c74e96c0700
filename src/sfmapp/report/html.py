"""The report as one self-contained page of HTML: no script, no file beside it, nothing fetched."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from sfmapp.report.top_view import top_view_svg

if TYPE_CHECKING:
    from sfmapp.scene.reconstruction import Reconstruction

MAX_DECISIONS = 400

STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.1rem;margin-top:2rem}
table{border-collapse:collapse;font-size:.88rem;font-variant-numeric:tabular-nums}
.wide{overflow-x:auto}
th,td{padding:.25rem .6rem;border-bottom:1px solid #8884;text-align:right;white-space:nowrap}
th{font-weight:600;vertical-align:bottom}td.t,th.t{text-align:left}td.w{text-align:left;white-space:normal;min-width:18rem}
.green::before,.amber::before,.red::before{content:"";display:inline-block;width:.75rem;height:.75rem;
border-radius:50%;margin-right:.5rem}
.green::before{background:#2a9d4a}.amber::before{background:#e0a100}.red::before{background:#d1372c}
.failure{border-left:.3rem solid #d1372c;padding:.3rem 1rem;background:#d1372c18}
.dim{color:#888}svg{width:100%;max-height:32rem;border:1px solid #8884}details{margin:.5rem 0}
"""

FUNNEL = (
    ("features", "features"),
    ("candidate_pairs", "pairs tried"),
    ("verified_pairs", "pairs verified"),
    ("putative_matches", "matches"),
    ("verified_matches", "verified"),
    ("correspondences_2d3d", "points seen"),
    ("pose_inliers", "agree with pose"),
    ("observations", "observations"),
)


def render_html(report: Mapping[str, Any], model: Reconstruction | None) -> str:
    """The page of a report; with the largest model it shows a view from above."""
    run, outcome = report["run"], report["outcome"]
    title = f"sfmapp: {run['source']}"
    body = [f"<h1>{escape(title)}</h1>", _headline(report)]
    if outcome["exit_code"]:
        advice = f"<p>{escape(outcome['advice'])}</p>" if outcome.get("advice") else ""
        body.append(f'<div class="failure"><p><b>{escape(outcome["message"])}</b></p>{advice}</div>')
    if report["checks"]:
        body.append("<h2>Checks</h2>" + _checks(report["checks"]))
    if model is not None:
        note = "Points and cameras of the largest model; each triangle opens where its camera looks."
        body.append(f'<h2>From above</h2>{top_view_svg(model)}<p class="dim">{note}</p>')
    body.append(_failed(report["images"]) + _skipped(report["skipped"]))
    body.append("<h2>Images</h2>" + _images(report["images"]))
    body.append("<h2>Cameras</h2>" + _cameras(report["cameras"]))
    body.append("<h2>Time and memory</h2>" + _usage(report))
    body.append(_log("Warnings", report["warnings"]) + _log("Decisions", report["decisions"]))
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    return (
        f"<!doctype html><html lang=en><head>{head}<style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )


def _headline(report: Mapping[str, Any]) -> str:
    run = report["run"]
    parts = []
    if report["models"]:
        model = report["models"][0]
        parts.append(f"{model['num_registered']} of {model['num_images']} images registered")
        parts.append(f"{model['num_points']} points")
        parts.append(f"{model['mean_reprojection_error_px']:.2f} px")
    parts += [f"{run['wall_s']:.1f} s", f"seed {run['seed']}", f"sfmapp {run['versions']['sfmapp']}", run["started"]]
    return f'<p class="dim">{escape("; ".join(parts))}</p>'


def _checks(checks: Iterable[Mapping[str, str]]) -> str:
    rows = [
        [("t " + check["light"], check["name"]), ("", check["value"]), ("t dim", check["thresholds"])]
        for check in checks
    ]
    return _table([("t", "check"), ("", "value"), ("t", "thresholds")], rows)


def _images(images: Iterable[Mapping[str, Any]]) -> str:
    head = [("t", "image"), ("", "model"), *(("", label) for _, label in FUNNEL)]
    rows = []
    for image in images:
        light = "green" if image["is_registered"] else "red"
        counts = [("", image["funnel"][key]) for key, _ in FUNNEL]
        rows.append([(f"t {light}", image["name"]), ("", image["model"]), *counts])
    return _table(head, rows)


def _failed(images: Iterable[Mapping[str, Any]]) -> str:
    rows = [
        [("t red", image["name"]), ("t", image["failed_at"]), ("w", image["reason"]), ("w", image["remedy"])]
        for image in images
        if not image["is_registered"]
    ]
    if not rows:
        return ""
    head = [("t", "image"), ("t", "failed at"), ("t", "why"), ("t", "what helps")]
    return "<h2>Images in no model</h2>" + _table(head, rows)


def _skipped(skipped: Sequence[Mapping[str, str]]) -> str:
    if not skipped:
        return ""
    rows = [[("t red", entry["name"]), ("w", entry["reason"])] for entry in skipped]
    return "<h2>Files that could not be used</h2>" + _table([("t", "file"), ("t", "reason")], rows)


def _cameras(cameras: Iterable[Mapping[str, Any]]) -> str:
    head = [("", "camera"), ("t", "model"), ("", "size"), ("", "images"), ("t", "focal prior"), ("t", "parameters")]
    rows = []
    for camera in cameras:
        refined, texts = camera["refined"] or {}, []
        for name, value in camera["initial"].items():
            text = f"{name} {value:.5g}"
            if name in refined and refined[name] != value:
                text += f" \N{RIGHTWARDS ARROW} {refined[name]:.5g}"
            if name in camera["sigma"]:
                text += f" \N{PLUS-MINUS SIGN} {camera['sigma'][name]:.2g}"
            texts.append(text)
        sigma = camera["focal_sigma_px"]
        prior = camera["focal_source"] + (f" \N{PLUS-MINUS SIGN} {sigma:.0f} px" if sigma else "")
        size = f"{camera['width']} x {camera['height']}"
        cells = [("", camera["idx"]), ("t", camera["model"]), ("", size), ("", camera["num_images"])]
        rows.append([*cells, ("t", prior + (", fixed" if camera["is_fixed"] else "")), ("w", ", ".join(texts))])
    return _table(head, rows)


def _usage(report: Mapping[str, Any]) -> str:
    head = [("t", "stage"), ("", "wall s"), ("", "CPU s"), ("", "peak MB so far"), ("t", "")]
    rows = []
    for name, entry in [*report["usage"].items(), ("whole run", report["run"])]:
        peak = f"{entry['peak_memory_mb']:.0f}" if "peak_memory_mb" in entry else None
        note = "in the background of the others" if peak is None else ""
        numbers = [("", f"{entry['wall_s']:.2f}"), ("", f"{entry['cpu_s']:.2f}"), ("", peak)]
        rows.append([("t", name), *numbers, ("t dim", note)])
    return _table(head, rows)


def _log(title: str, lines: Sequence[Mapping[str, Any]]) -> str:
    if not lines:
        return ""
    rows = [[("", f"{line['time_s']:.2f}"), ("t", line["stage"]), ("w", line.get("message", ""))] for line in lines]
    more = f"<p class=dim>{len(rows) - MAX_DECISIONS} more in report.json</p>" if len(rows) > MAX_DECISIONS else ""
    table = _table([("", "s"), ("t", "stage"), ("t", "what")], rows[:MAX_DECISIONS])
    return f"<details><summary>{title} ({len(rows)})</summary>{table}{more}</details>"


def _table(head: Sequence[tuple[str, Any]], rows: Iterable[Sequence[tuple[str, Any]]]) -> str:
    """A table of (class, value) cells; None prints as nothing."""

    def cells(tag: str, row: Sequence[tuple[str, Any]]) -> str:
        texts = [(kind, "" if value is None else escape(str(value))) for kind, value in row]
        return "".join(
            f'<{tag} class="{kind}">{text}</{tag}>' if kind else f"<{tag}>{text}</{tag}>" for kind, text in texts
        )

    lines = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>{lines}</table></div>'
