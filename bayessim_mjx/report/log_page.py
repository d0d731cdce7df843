"""show.html: one self-contained page of recorded motion, plotly.js inside, nothing loaded from anywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from bayessim_mjx.logs import excited, views
from bayessim_mjx.logs.views import Sheet, View
from bayessim_mjx.quantities import compact, count, duration, percent
from bayessim_mjx.report import log_figures
from bayessim_mjx.report.choice import choice
from bayessim_mjx.report.look import COLUMN, WIDTH
from bayessim_mjx.report.page import environment
from bayessim_mjx.report.words import page

TEMPLATE = "log_page.html.j2"
POINTS = 400_000  # of all lines over time: a page of about 8 MB, which browsers of phones open; a rule of thumb
FEWEST, MOST = 120, 1500  # points of one line; a rule of thumb: twice the width of the figure is enough
PANELS = 240  # figures over time at most; a rule of thumb
MAPS = 24  # joints with a map of coverage and a spectrum; a rule of thumb
FEW = 4  # joints whose maps are large; a rule of thumb
GROUP = 6  # channels of one figure without joints; a rule of thumb


def write(shown: View, path: Path, source: str) -> Path:
    """Write the page of logs; returns its path. `source`: the folder's name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render(shown, source), encoding="utf-8")
    return path


def render(shown: View, source: str) -> str:
    """Return the page as text."""
    from plotly.offline import get_plotlyjs

    joints = views.joints(shown.sheets)
    found = excited.excitation(shown.sheets)
    return environment().get_template(TEMPLATE).render(
        plotly=Markup(get_plotlyjs()),
        width=WIDTH,
        column=COLUMN,
        tone="#5b6670" if not shown.overview.faults else "#8a5a00",
        source=source,
        headline=_headline(shown, joints),
        tiles=_tiles(shown.sheets),
        notes=[page(text) for text in shown.overview.notes],
        missing=[page(text) for text in shown.overview.faults],
        over_time=_over_time(shown, joints),
        units=bool(shown.units),
        left=max(0, len(shown.sheets) - _files_shown(shown.sheets, joints)),
        spectra=_spectra(shown, joints),
        coverage=_coverage(shown, joints),
        excitation=log_figures.excited(found) if found is not None and np.isfinite(found.coherence).any() else None,
        strongest=_strongest(found),
        periods=log_figures.periods(shown.sheets, 6000),
        files=_table(("file", "rows", "length", "rate", "jitter", "gaps"), shown.overview.files),
        columns=_table(("column", "channel", "unit", "values", "note"), shown.overview.columns),
    )  # fmt: skip


def _headline(shown: View, joints: Sequence[str]) -> str:
    commands = {n for s in shown.sheets for n in s.names("ctrl")}
    total = sum(float(s.time[-1] - s.time[0]) for s in shown.sheets)
    files = {s.name.partition("#")[0] for s in shown.sheets}  # a file with gaps is several sheets
    parts = [count(len(files), "log"), f"{duration(total)} of motion"]
    parts += [count(len(joints), "position")] if joints else []
    parts += [count(len(commands), "command")] if commands else []
    return ", ".join(parts)


def _tiles(sheets: Sequence[Sheet]) -> list[dict[str, str]]:
    steps = np.concatenate([np.diff(s.time) for s in sheets])
    step = float(np.median(steps))
    rows = sum(len(s.time) for s in sheets)
    late = float(np.mean(steps > 1.5 * step))
    usual = steps[np.abs(steps / step - 1) < 0.9]
    jitter = float(np.std(usual))
    jitter = jitter if jitter > 1e-6 * step else 0.0  # below, it is that of floating point
    return [
        {"words": "rows", "value": compact(rows), "unit": ""},
        {"words": "rate", "value": compact(1 / step), "unit": "Hz"},
        {"words": "jitter (sd)", "value": compact(1e3 * jitter, 2), "unit": "ms"},
        {"words": "late rows", "value": percent(late), "unit": ""},
    ]


def _files_shown(sheets: Sequence[Sheet], joints: Sequence[str]) -> int:
    return max(1, min(len(sheets), PANELS // max(len(joints), 1)))


def _channels(sheet: Sheet, joint: str, pairs: dict[str, list[str]]) -> list[str]:
    """Channels of one joint: its commands, position, velocity and efforts."""
    bare = joint.partition("[")[0]
    drives = pairs.get(bare) or [n for n in sheet.names("ctrl") if bare in (n, n.removesuffix("_motor")) or n == bare]
    names = [f"ctrl:{n}" for n in drives] + [f"qpos:{joint}"]
    names += [f"qvel:{joint}"] if views.velocity(sheet, joint) is not None else []
    names += [f"effort:{n}" for n in drives]
    return [n for n in names if n in sheet.channels or n == f"qvel:{joint}"]


def _over_time(shown: View, joints: Sequence[str]) -> dict[str, Any]:
    """Figures by log and by joint; channels of no joint in groups."""
    plans: list[tuple[tuple[str, str], Sheet, list[str]]] = []
    sheets, pairs = shown.sheets, shown.pairs
    for sheet in sheets[: _files_shown(sheets, joints)]:
        used: set[str] = set()
        for joint in joints:
            names = _channels(sheet, joint, pairs)
            if f"qpos:{joint}" in sheet.channels:
                plans.append(((sheet.name, joint), sheet, names))
                used |= set(names)
        rest = [n for n in sheet.channels if n not in used and np.isfinite(sheet.channels[n]).any()]
        for k in range(0, len(rest), GROUP):
            label = "other channels" + (f" {k // GROUP + 1}" if len(rest) > GROUP else "")
            plans.append(((sheet.name, label), sheet, rest[k : k + GROUP]))
    plans = plans[:PANELS]
    lines = max(sum(len(names) for _, _, names in plans), 1)
    most = int(np.clip(POINTS / lines, FEWEST, MOST))
    figures = [(keys, log_figures.over_time(sheet, names, most, shown.units)) for keys, sheet, names in plans if names]
    return choice(("log", "channels"), figures)


def _spectra(shown: View, joints: Sequence[str]) -> dict[str, Any]:
    figures, sheets, pairs = [], shown.sheets, shown.pairs
    for joint in joints[:MAPS]:
        names = dict.fromkeys(n for s in sheets for n in _channels(s, joint, pairs))
        made = log_figures.spectra(sheets, list(names), shown.units)
        if made is not None:
            figures.append(((joint,), made))
    if not figures:
        names = dict.fromkeys(n for s in sheets for n in s.channels)
        every = [(name, log_figures.spectra(sheets, [name], shown.units)) for name in list(names)[:MAPS]]
        figures = [((name,), made) for name, made in every if made is not None]
    return choice(("channel",), figures) if figures else {"axes": [], "panels": []}


def _coverage(shown: View, joints: Sequence[str]) -> dict[str, Any]:
    """Make maps of the joints, and a table of their numbers."""
    maps: list[dict[str, Any]] = []
    rows = []
    for joint in joints:
        limits = shown.limits.get(joint)
        found = views.coverage(shown.sheets, joint, limits)
        if found is None:
            continue
        if len(maps) < MAPS:
            high = 300 if len(joints) <= FEW else 220
            maps.append(log_figures.covered(joint, found, limits, high, shown.units.get(f"qpos:{joint}", "")))
        place, speed = (shown.units.get(f"{stream}:{joint}", "") for stream in ("qpos", "qvel"))
        span = f"{compact(found.low, 3)} to {compact(found.high, 3)} {place}".rstrip()
        share = percent(found.range_share) if found.range_share is not None else "–"
        fastest = f"{compact(found.fastest, 3)} {speed}".rstrip()
        rows.append((joint, span, share, fastest, percent(found.rest), str(found.turns)))
    heads = ("joint", "positions", "share of its range", "fastest", "at rest", "reversals")
    return {"maps": maps, "table": _table(heads, rows), "left": max(0, len(rows) - len(maps))}


def _strongest(found: Any) -> dict[str, Any]:
    """Table of each joint: the command with which it moves most, and the next one."""
    rows = []
    for j, joint in enumerate(found.joints if found is not None else ()):
        own = found.coherence[:, j]
        if not np.isfinite(own).any():
            continue
        order = np.argsort(-np.nan_to_num(own, nan=-1.0))
        best, next_ = int(order[0]), int(order[1]) if len(order) > 1 else None
        other = (
            f"{found.commands[next_]} ({own[next_]:.2f})" if next_ is not None and math.isfinite(own[next_]) else "–"
        )
        rows.append((joint, found.commands[best], f"{own[best]:.2f}", other))
    return _table(("joint", "moves with", "coherence", "next best"), rows)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Rows for the template's table; numbers stand on the right."""
    right = [all(row[k][:1] in "–-0123456789" for row in rows) for k in range(len(heads))] if rows else []
    cells = [[{"text": cell, "number": number} for cell, number in zip(row, right, strict=True)] for row in rows]
    return {"heads": list(heads), "rows": cells}
