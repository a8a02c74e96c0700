"""What the pages of all reports share: the frame, the look, tables, traffic lights and logs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from sfmapp.adjust.options import AdjustReport
from sfmapp.report.model import Check, LogLine, Outcome
from sfmapp.reporting import Usage

MAX_DECISIONS = 400

# Longer values are sentences, which are wrapped.
_MAX_SHORT = 40

STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.1rem;margin-top:2rem}h3{font-size:.95rem;margin:1.2rem 0 .4rem}
.wide+.wide{margin-top:1rem}
table{border-collapse:collapse;font-size:.88rem;font-variant-numeric:tabular-nums}
.wide{overflow-x:auto}
th,td{padding:.25rem .6rem;border-bottom:1px solid #8884;text-align:right;white-space:nowrap}
th{font-weight:600;vertical-align:bottom;white-space:normal}td.t,th.t{text-align:left}td.w{text-align:left;white-space:normal;min-width:18rem}
.green::before,.amber::before,.red::before,.grey::before{content:"";display:inline-block;width:.75rem;height:.75rem;
border-radius:50%;margin-right:.5rem}
.green::before{background:#2a9d4a}.amber::before{background:#e0a100}.red::before{background:#d1372c}.grey::before{background:#8888}
.failure{border-left:.3rem solid #d1372c;padding:.3rem 1rem;background:#d1372c18}
.dim{color:#888}svg{width:100%;max-height:32rem;border:1px solid #8884}details{margin:.5rem 0}
.plot{max-height:none}.plot text,.view text{fill:currentColor;font-size:13px}.grid{stroke:#8884}
.bar{fill:#4a7fd4}.row{display:grid;grid-template-columns:repeat(auto-fit,minmax(16rem,1fr));gap:.8rem}
.row h3{margin:.4rem 0}.large{grid-template-columns:repeat(auto-fit,minmax(28rem,1fr))}
figure{margin:0}figure img{width:100%;display:block}figcaption{font-size:.85rem;color:#888;padding:.2rem 0}
"""


def render_page(title: str, body: Iterable[str]) -> str:
    """One self-contained page of HTML: no script, no file beside it, nothing fetched."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    parts = [f"<h1>{escape(title)}</h1>", *body]
    return (
        f"<!doctype html><html lang=en><head>{head}<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def failure_box(outcome: Outcome) -> str:
    """Why there is no result and what helps, where there is none."""
    if not outcome.exit_code:
        return ""
    advice = f"<p>{escape(outcome.advice)}</p>" if outcome.advice else ""
    return f'<div class="failure"><p><b>{escape(outcome.message)}</b></p>{advice}</div>'


def check_table(checks: Iterable[Check]) -> str:
    """Traffic lights; nothing without any."""
    rows = [
        [
            ("t " + check.light, check.name),
            ("w" if len(check.value) > _MAX_SHORT else "", check.value),
            ("w dim", check.thresholds),
        ]
        for check in checks
    ]
    return "<h2>Checks</h2>" + table([("t", "check"), ("", "value"), ("t", "thresholds")], rows) if rows else ""


def usage_table(usage: Mapping[str, Usage], run: Usage) -> str:
    """Time and memory of the stages and of the whole run."""
    head = [("t", "stage"), ("", "wall s"), ("", "CPU s"), ("", "peak MB so far"), ("t", "")]
    rows = []
    for name, entry in [*usage.items(), ("whole run", run)]:
        peak = f"{entry.peak_memory_mb:.0f}" if entry.peak_memory_mb is not None else None
        note = "in the background of the others" if peak is None else ""
        numbers = [("", f"{entry.wall_s:.2f}"), ("", f"{entry.cpu_s:.2f}"), ("", peak)]
        rows.append([("t", name), *numbers, ("t dim", note)])
    return "<h2>Time and memory</h2>" + table(head, rows)


def adjustment_table(entries: Iterable[tuple[str, AdjustReport | None]]) -> str:
    """What the factors of closing adjustments came to; entries are names of models or maps with theirs."""
    head = [
        ("t", ""),
        ("t", "factors"),
        ("", "count"),
        ("", "residual"),
        ("", "rejected"),
        ("", "cost"),
        ("t", ""),
    ]
    rows = []
    for name, report in entries:
        if report is None:
            continue
        size = f"{report.num_unknowns} unknowns, {report.fill:.0%} full, solved by {report.solver}"
        notes = [size, f"{report.num_iterations} steps, {report.termination}; cost {report.initial_cost:.6g} at first"]
        for n, factors in enumerate(report.factors):
            numbers = [
                ("", factors.num_factors),
                ("", report.residual_text(factors)),
                ("", factors.num_rejected),
            ]
            note = notes[n] if n < len(notes) else ""
            cost = ("", f"{factors.cost:.6g}")
            rows.append([("t", "" if n else name), ("t", factors.kind), *numbers, cost, ("t dim", note)])
    return "<h2>Closing adjustment</h2>" + table(head, rows) if rows else ""


def log_table(title: str, lines: Sequence[LogLine]) -> str:
    """What was decided or warned of, folded away."""
    if not lines:
        return ""
    rows = [[("", f"{line.time_s:.2f}"), ("t", line.stage), ("w", line.message or "")] for line in lines]
    more = f"<p class=dim>{len(rows) - MAX_DECISIONS} more in report.json</p>" if len(rows) > MAX_DECISIONS else ""
    lines_table = table([("", "s"), ("t", "stage"), ("t", "what")], rows[:MAX_DECISIONS])
    return f"<details><summary>{title} ({len(rows)})</summary>{lines_table}{more}</details>"


def table(head: Sequence[tuple[str, Any]], rows: Iterable[Sequence[tuple[str, Any]]]) -> str:
    """A table of (class, value) cells; None prints as nothing."""

    def cells(tag: str, row: Sequence[tuple[str, Any]]) -> str:
        texts = [(kind, "" if value is None else escape(str(value))) for kind, value in row]
        return "".join(
            f'<{tag} class="{kind}">{text}</{tag}>' if kind else f"<{tag}>{text}</{tag}>" for kind, text in texts
        )

    lines = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>{lines}</table></div>'
