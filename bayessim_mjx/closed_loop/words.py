"""What a closed-loop study found, in words and as a table on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.closed_loop.measures import FEWEST
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.quantities import compact, count, estimate, percent

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
    """Write the findings, most important first."""
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
    was, now = (compact(mean_return(found, "nominal", s)) for s in ("nominal", "corrected"))
    text = f"For the policy {ROLES['nominal']}, that simulator predicts {was} and the corrected one {now}"
    if not found["gap"]:
        better = compact(mean_return(found, "corrected", "corrected"))
        return f"{text}, and {better} after retraining on it."
    reached, closed = compact(mean_return(found, "nominal", "real")), found["gap"]["policy"]["closure"]
    share = (
        "; there was no gap to close" if closed is None else f": {percent(closed)} of the gap of the return is closed"
    )
    return f"{text}; on the real system it reaches {reached}{share}."


def _recovery(r: Mapping[str, Any]) -> str:
    if r["corrected"]["recovered"] is None:
        return "The gap costs no measurable return: a policy trained on the real system itself is not clearly better."
    wide = r["wide"]["recovered"]
    return (
        f"Retraining on the corrected simulator recovers {percent(r['corrected']['recovered'])} of the lost return "
        f"({_interval(r)}); wide randomisation without a diagnosis {percent(wide)}."
    )


def _interval(r: Mapping[str, Any]) -> str:
    if r["corrected"]["ci"]:
        return "90 % interval {} to {}".format(*map(percent, r["corrected"]["ci"]))
    if r["seeds"] >= FEWEST:
        return "no interval: the loss is not known well enough"
    return f"{count(r['seeds'], 'seed')}: no interval; trainings differ, --seeds {FEWEST} gives one"


def _ranking(r: Mapping[str, Any]) -> str:
    before, after = r["tau"]["nominal"], r["tau"]["corrected"]
    if before is None or after is None:
        return ""
    return f"Kendall's tau of {r['policies']} policies against the real system: {before:.2f} before, {after:.2f} after."


def _replay(r: Mapping[str, Any]) -> str:
    rms = {s: float(np.sqrt(np.mean([e[s] ** 2 for e in r["error"].values()]))) for s in ("nominal", "corrected")}
    return (
        f"With each log's controller in closed loop over {r['seconds']:.3g} s, the position error is "
        f"{compact(rms['nominal'])} on the simulator as it was and {compact(rms['corrected'])} on the corrected one."
    )


def show(found: Mapping[str, Any], console: Console) -> None:
    """Print the tables and the sentences."""
    _returns(found, console)
    if found["effects"]:
        _effects(found["effects"], console)
    for sentence in found["sentences"]:
        console.say(sentence)


def _returns(found: Mapping[str, Any], console: Console) -> None:
    simulators = list(found["policies"]["nominal"][0]["returns"])
    rows = [[ROLES[role], *(_plus_minus(each, s) for s in simulators)] for role, each in found["policies"].items()]
    console.grid(["policy", *(SIMULATORS[s] for s in simulators)], rows, "return on")


def _plus_minus(each: Sequence[Mapping[str, Any]], simulator: str) -> str:
    """Mean over seeds, and its standard error (over episodes where there is one seed)."""
    means = [p["returns"][simulator]["mean"] for p in each]
    error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else each[0]["returns"][simulator]["se"]
    return estimate(np.mean(means), error)


def _effects(effects: Sequence[Mapping[str, Any]], console: Console) -> None:
    rows = []
    for e in effects:
        every = [e["change"][role][how] for role in ("nominal", "corrected") for how in ("alone", "last")]
        changes = [estimate(x["mean"], x["se"]) for x in every]
        rows.append([e["effect"], e["where"], *changes, "no" if e["irrelevant"] else "yes"])
    columns = ["effect", "where", "before: alone", "with the others", "retrained: alone", "with the others", "matters"]
    console.grid(columns, rows, "change of return by", left=(0, 1))
