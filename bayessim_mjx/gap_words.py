"""What a closed-loop study found, in words and as a table on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

import numpy as np

from bayessim_mjx.monitor.console import FILE_WIDTH
from bayessim_mjx.monitor.words import ascii_of, number

ROLES = {
    "nominal": "trained on the simulator as it was",
    "corrected": "trained on the corrected simulator",
    "wide": "trained with wide randomisation",
    "oracle": "trained on the real system",
}
SIMULATORS = {"nominal": "as it was", "corrected": "corrected", "posterior": "corrected, uncertain", "real": "real"}


def mean_return(found: Mapping[str, Any], role: str, simulator: str) -> float:
    """Mean over seeds."""
    return float(np.mean([p["returns"][simulator]["mean"] for p in found["policies"][role]]))


def sentences(found: Mapping[str, Any]) -> list[str]:
    """The findings, most important first."""
    out = [_prediction(found)]
    if found["recovery"]:
        out += [_recovery(found["recovery"]), _ranking(found["ranking"])]
    elif found["replay"]:
        out.append(_replay(found["replay"]))
    else:
        out.append("No log declares a controller (metadata `controller: {law, kp, kd}`), so none was replayed.")
    idle = [f"{e['effect']} at {e['where']}" for e in found["effects"] if e["irrelevant"]]
    if idle:
        out.append(f"By itself each of these could be left out for this task: {', '.join(idle)}.")
    return [s for s in out if s]


def _prediction(found: Mapping[str, Any]) -> str:
    was, now = (number(mean_return(found, "nominal", s)) for s in ("nominal", "corrected"))
    text = f"The policy {ROLES['nominal']} was predicted to reach {was} there; the corrected simulator predicts {now}"
    if not found["gap"]:
        better = number(mean_return(found, "corrected", "corrected"))
        return f"{text}, and {better} after retraining on it."
    reached, closed = number(mean_return(found, "nominal", "real")), found["gap"]["policy"]["closure"]
    share = (
        "; there was no gap to close" if closed is None else f": {_percent(closed)} of the gap of the return is closed"
    )
    return f"{text}; on the real system it reaches {reached}{share}."


def _recovery(r: Mapping[str, Any]) -> str:
    if r["corrected"]["recovered"] is None:
        return (
            "The gap costs no return worth the name: the policy trained on the real system itself is not surely better."
        )
    (low, high), wide = r["corrected"]["ci"], r["wide"]["recovered"]
    return (
        f"Retraining on the corrected simulator recovers {_percent(r['corrected']['recovered'])} of the lost return "
        f"(90 % interval {_percent(low)} to {_percent(high)}); wide randomisation without a diagnosis {_percent(wide)}."
    )


def _ranking(r: Mapping[str, Any]) -> str:
    before, after = r["tau"]["nominal"], r["tau"]["corrected"]
    if before is None or after is None:
        return ""
    return f"Kendall's tau of {r['policies']} policies against the real system: {before:.2f} before, {after:.2f} after."


def _replay(r: Mapping[str, Any]) -> str:
    rms = {s: float(np.sqrt(np.mean([e[s] ** 2 for e in r["error"].values()]))) for s in ("nominal", "corrected")}
    return (
        f"The logs' own controller in closed loop over {r['seconds']:.3g} s: position error "
        f"{number(rms['nominal'])} as it was, {number(rms['corrected'])} corrected."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def show(found: Mapping[str, Any], headless: bool = False, file: TextIO | None = None) -> None:
    """Print the tables and the sentences; without a terminal (or `headless`) no control characters."""
    from rich.console import Console

    file = file or sys.stdout
    live = not headless and bool(getattr(file, "isatty", lambda: False)())
    options: dict[str, Any] = {} if live else dict(force_terminal=False, no_color=True, width=FILE_WIDTH)
    unicode = "utf" in (getattr(file, "encoding", None) or "utf-8").lower()
    rich = Console(file=file, highlight=False, markup=False, **options)
    rich.print(_returns(found, unicode))
    if found["effects"]:
        rich.print(_effects(found["effects"], unicode))
    for sentence in found["sentences"]:
        rich.print(sentence if unicode else ascii_of(sentence), soft_wrap=True)


def _returns(found: Mapping[str, Any], unicode: bool) -> Any:
    simulators = list(found["policies"]["nominal"][0]["returns"])
    rows = [[ROLES[role], *(f"{_plus_minus(each, s)}" for s in simulators)] for role, each in found["policies"].items()]
    return _table("return on", ["policy", *(SIMULATORS[s] for s in simulators)], rows, unicode)


def _plus_minus(each: Sequence[Mapping[str, Any]], simulator: str) -> str:
    """Mean over seeds, and its standard error (over episodes where there is one seed)."""
    means = [p["returns"][simulator]["mean"] for p in each]
    error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else each[0]["returns"][simulator]["se"]
    return f"{number(float(np.mean(means)))} ± {number(float(error))}"


def _effects(effects: Sequence[Mapping[str, Any]], unicode: bool) -> Any:
    rows = []
    for e in effects:
        every = [e["change"][role][how] for role in ("nominal", "corrected") for how in ("alone", "last")]
        changes = [f"{number(x['mean'])} ± {number(x['se'])}" for x in every]
        rows.append([e["effect"], e["where"], *changes, "no" if e["irrelevant"] else "yes"])
    columns = ["effect", "where", "before: alone", "with the others", "retrained: alone", "with the others", "matters"]
    return _table("change of return by", columns, rows, unicode)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], unicode: bool) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD if unicode else box.ASCII)
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*(cell if unicode else ascii_of(cell) for cell in row))
    return table
