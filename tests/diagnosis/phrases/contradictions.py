"""Where the sentences of a diagnosis.json contradict its numbers, or each other.

    python -m tests.diagnosis.phrases.contradictions FILE ...      (diagnosis.json, or one with it under `said`)

It reads texts as a person does, and shares nothing with the code that makes them but the definition of the gap.
"""

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Said = dict[str, Any]
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
AT_NOISE = 1.15  # noise sd (docs/decisions/at_noise.md)
UNEXPLAINED = 0.15  # share left, from which on effects are no explanation (`summary.verdict.Limits.share`)
RELEVANT = 0.003  # share of the gap (docs/decisions/relevance_and_odds.md)
CLEARLY = 3.0  # nats: odds of 20 (docs/decisions/relevance_and_odds.md)
IN_UNIT = {"ms": 1e-3, "deg": math.pi / 180, "mm": 1e-3}


def contradictions(said: Said) -> list[tuple[str, str]]:
    """[(kind, what contradicts what)] of a diagnosis.json."""
    rules = (
        _levels,
        _closed,
        _quoted,
        _sizes,
        _intervals,
        _extents,
        _verdict,
        _tolerance,
        _predicted,
        _places,
        _hidden,
        _ranked,
        _larger,
        _ways,
    )
    return [found for rule in rules for found in rule(said)]


def text_of(said: Said) -> str:
    return "\n".join(said["sentences"])


def rounds_to(value: Any, text: str, scale: float = 1.0) -> bool:
    """Whether a number is printed so, to half a unit of the last digit."""
    if value is None:
        return False
    digits = text.partition("e")[0].partition(".")[2]
    return abs(float(value) / scale - float(text)) <= 0.5001 * 10.0 ** -len(digits) + 1e-9


def share(before: float, after: float) -> float:
    """Of the squared gap above the noise, in noise standard deviations."""
    above = before**2 - 1.0
    return (before**2 - max(after**2, 1.0)) / above if above > 0 else math.nan


def numbers(value: Any) -> Iterator[float]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return
    if isinstance(value, int | float):
        yield float(value)
    else:
        for own in value.values() if isinstance(value, dict) else value:
            yield from numbers(own)


def _levels(said: Said) -> Iterator[tuple[str, str]]:
    """Gaps in noise standard deviations, and `within the noise` beside them."""
    known = [*numbers({k: v for k, v in said["gap"].items() if k not in ("physical", "shares", "closed")})]
    for level, within in re.findall(rf"({NUMBER}) noise sd(, within the noise)?", text_of(said)):
        if not any(rounds_to(v, level) for v in known):
            yield "size", f"{level} noise sd is no number of the gap"
        if within and float(level) > AT_NOISE + 0.005:
            yield "words", f"{level} noise sd is called within the noise"


def _closed(said: Said) -> Iterator[tuple[str, str]]:
    """The share in the sentence on the fall of the gap, against the two gaps that the sentence quotes."""
    for sentence in said["sentences"]:
        if not re.search(r"gap falls from|(reduces?|raises?) the gap from", sentence):
            continue
        levels = [float(x) for x in re.findall(rf"({NUMBER}) noise sd", sentence)]
        if len(levels) != 2:
            yield "words", f"two gaps are expected in: {sentence}"
            continue
        raised = bool(re.search("raises? the gap", sentence))
        if said["effects"] and levels[1] != levels[0] and raised != (levels[1] > levels[0]):
            yield "words", f"the gap {'falls' if raised else 'rises'} from {levels[0]} to {levels[1]}: {sentence}"
        quoted = re.search(rf"This closes ({NUMBER}) % of the squared gap above the noise", sentence)
        own = share(said["gap"]["calibrated"], said["gap"]["with_effects"])
        if quoted and said["effects"] and not math.isnan(own) and abs(float(quoted[1]) / 100 - own) > 0.02:
            yield "share", f"{quoted[1]} % closed, {own:.1%} by {levels[0]} -> {levels[1]}"


def _quoted(said: Said) -> Iterator[tuple[str, str]]:
    """Shares whose datum is known, and others, which must be some number of the result."""
    gap, basis, chance = said["gap"], said.get("basis") or {}, (said.get("basis") or {}).get("probability") or {}
    held = [h["closed"] for h in ((basis.get("flexible") or {}).get("held") or {}).values()]
    shares = {k: max(v, 0.0) for k, v in (gap.get("closed") or {}).items() if isinstance(v, float)}
    closed, sheet = shares, {k: share(*v) for k, v in _falls(said).items()}
    exact = {
        r"linear step predicted": [closed.get("predicted")],
        "in turn, the effect closes": [closed.get("realised")],
        "in turn, the effects close": [closed.get("realised")],
        "leaves it out, the effect closes": [closed.get("elsewhere")],
        "leaves it out, the effects close": [closed.get("elsewhere")],
        r"closes the rest,": [1.0 - sheet["effects"]],
        "the effect leaves": [1.0 - sheet["effects"]],
        "the effects leave": [1.0 - sheet["effects"]],
        r"that force makes": [basis.get("remains")],
        "among all fitted explanations:": [chance.get("answer")],
        "for this one,": [chance.get("rivals")],
        "as well have": [_with_more(said)],
        "of a wrong data sheet is": [chance.get("nothing")],
        r"force removes": held,
        r"The effects close": [max(sheet["coasting"], 0.0)],
    }
    for before, of in re.findall(rf"({'|'.join(exact)}) ?({NUMBER}) %", text_of(said)):
        values = exact[before]
        if not any(v is not None and rounds_to(100 * v, of) for v in values):
            yield "share", f"'{before} {of} %', in the data {[round(v, 4) for v in values if v is not None]}"
    known = [*numbers(said), *(1 - v for v in numbers(gap)), *sheet.values(), 1 - sheet["effects"], 0.9, 0.1]
    known += [RELEVANT, *_further(said), _with_more(said)]
    known += [a / b for r in gap["physical"].values() for a in numbers(r) for b in [r.get("motion") or 0.0] if b]
    for of in re.findall(rf"({NUMBER}) ?%", text_of(said)):
        if not any(rounds_to(100 * v, of) for v in known):
            yield "source", f"{of} % is no number of the result"


def _with_more(said: Said) -> float:
    """Probability of the sets with the named effects and others."""
    named = {f"{e['name']}@{e['where']}" for e in said["effects"]}
    return float(sum(s["probability"] for s in said.get("evidence") or [] if named < {*s["effects"]}))


def _further(said: Said) -> list[float]:
    """Share of the gap that each set with the named effects and others closes beyond these."""
    named = {f"{e['name']}@{e['where']}" for e in said["effects"]}
    closed = {frozenset(c["effects"]): c.get("gap_closed") for c in said["candidates"]}
    own = closed.get(frozenset(named))
    return [] if own is None else [v - own for of, v in closed.items() if named < of and v is not None]


def _falls(said: Said) -> dict[str, tuple[float, float]]:
    gap = said["gap"]
    after = gap["with_effects"] if gap["with_effects"] is not None else math.nan
    before = gap["calibrated"] if gap["calibrated"] is not None else math.nan
    return {"effects": (before, after), "coasting": (gap.get("coasting") or math.nan, after)}


def _sizes(said: Said) -> Iterator[tuple[str, str]]:
    """`X +- Y unit` in the sentences, against the numbers of the effects."""
    known = []
    for e in said["effects"]:
        for name, p in e["parameters"].items():
            known.append((p["mean"], p["sd"]))
            known += [(p["mean"] * m, p["sd"] and p["sd"] * m) for m in (e.get("modelled") or {}).values()]
            if name.startswith(("inverse", "slowness")) and p["mean"]:
                known.append((1 / p["mean"], p["sd"] and p["sd"] / p["mean"] ** 2))
    known += [(p["mean"], p["sd"]) for p in said["parameters"].values() if "sd" in p]
    for mean, sd, unit in re.findall(rf"({NUMBER}) \+- ({NUMBER}) ?(ms)?", text_of(said)):
        scale = IN_UNIT.get(unit, 1.0)
        if not any(rounds_to(m, mean, scale) and rounds_to(s, sd, scale) for m, s in known):
            yield "size", f"{mean} +- {sd} {unit} is no effect's or parameter's number".replace("  ", " ")


def _intervals(said: Said) -> Iterator[tuple[str, str]]:
    """`X unit (90 %: a to b)` of a class, against the size that its members share."""
    known = [e["shared"] for e in said["effects"] if e.get("shared")]
    found = re.findall(rf"({NUMBER}) (\S+) \(90 %: ({NUMBER}) to ({NUMBER})\)", text_of(said))
    for mean, unit, low, high in found:
        scale = IN_UNIT.get(unit, 1.0)
        each = [(s["mean"], mean, s["low"], low, s["high"], high) for s in known]
        if not any(all(_near(v, t, scale) for v, t in zip(s[::2], s[1::2], strict=True)) for s in each):
            yield "interval", f"{mean} {unit} (90 %: {low} to {high}) is no class's size"


def _near(value: float, text: str, scale: float) -> bool:
    """As it is rounded, or to three significant digits."""
    return rounds_to(value, text, scale) or math.isclose(value / scale, float(text), rel_tol=5e-3)


def _extents(said: Said) -> Iterator[tuple[str, str]]:
    """Errors in degrees and millimetres, against those of the joints."""
    rows = said["gap"]["physical"].values()
    known = [v for r in rows for v in numbers(r)]
    for r in rows:  # above the noise
        level, noise = r.get("with_effects"), r.get("noise") or 0.0
        known += [math.sqrt(max(level**2 - noise**2, 0.0))] if level is not None else []
    for value, unit in re.findall(rf"({NUMBER}) (deg|mm)\b", text_of(said)):
        if not any(rounds_to(abs(v), value, IN_UNIT[unit]) for v in known):
            yield "size", f"{value} {unit} is no joint's number"


def _verdict(said: Said) -> Iterator[tuple[str, str]]:
    """Words of explanation against the verdict, and the verdict against the share that is left."""
    name, text, gap = said["verdict"], text_of(said), said["gap"]
    lacks = re.search(r"(?<!or the )simulator lacks(?! at)", re.sub(r"Without effects[^\n]*", "", text), re.I)
    if name in ("no_gap", "parameters", "noise") and lacks:
        yield "words", f"verdict {name}, but a sentence says that the simulator lacks something"
    if name in ("effects", "ambiguous") and re.search(r"no effect[^.]* explains", text, re.I):
        yield "words", f"verdict {name}, but a sentence says that no effect explains the gap"
    if name == "unexplained" and re.match(r"The simulator lacks|These logs fit", said["sentences"][0]):
        yield "words", "verdict unexplained, but the head names an explanation"
    if "No gap above the noise" in text and (gap["nominal"] or 0) > AT_NOISE:
        yield "words", f"no gap above the noise, but {gap['nominal']:.2f} noise sd"
    left = 1.0 - share(*_falls(said)["effects"])
    open_ = name in ("effects", "ambiguous") and left > UNEXPLAINED and gap["with_effects"] > 1.2
    if open_ and "covariance of" not in text and "cause of this rest is unknown" not in text:
        yield (
            "verdict",
            f"verdict {name}, but the effects leave {left:.0%} of the gap, {gap['with_effects']:.2f} noise sd",
        )


def _tolerance(said: Said) -> Iterator[tuple[str, str]]:
    text, beyond = text_of(said), said["gap"]["beyond"]
    if re.search(r"Every joint is within|within the tolerance at every joint", text) and beyond:
        yield "words", f"within the tolerance at every joint, but not {', '.join(beyond)}"
    if re.search(r"more than the tolerance remains at", text, re.I) and not beyond:
        yield "words", "more than the tolerance is said to remain, but no joint is beyond it"


def _predicted(said: Said) -> Iterator[tuple[str, str]]:
    """That nothing predicts the rest, beside a force that does."""
    text, held = text_of(said), ((said.get("basis") or {}).get("flexible") or {}).get("held") or {}
    nothing = re.search(r"nothing\s+predicts|no flexible force predicts|predicts nothing|finds nothing more", text)
    some = re.search(r"flexible force removes|flexible force [^.]*still (closes|predicts)|flexible force on top", text)
    if nothing and (some or any(h["significant"] for h in held.values())):
        yield "predicts", f"'{nothing[0]}', beside a flexible force that is significant"
    if some and held and not any(h["significant"] for h in held.values()):
        yield "predicts", "a flexible force is said to predict, but is not significant"


def _places(said: Said) -> Iterator[tuple[str, str]]:
    """A missing force of the simulator without the effects, as if it were missing with them."""
    for sentence in said["sentences"]:
        if said["effects"] and re.match(r"missing at |\S+: (of )?the missing force|\S+: the effort acts", sentence):
            yield "place", f"missing beside named effects: {sentence}"


def _hidden(said: Said) -> Iterator[tuple[str, str]]:
    """Effects that are said not to show, although they are named or stand in the answer's place."""
    members = {f"{e['name']}@{e['where']}" for e in said["effects"]}
    members |= {x for e in said["effects"] for r in e["equivalent_to"] if "weight" in r for x in r["effects"]}
    listed = re.search(r"There may also be ([^.\n]*)", text_of(said))
    others = [label for label in said.get("hidden") or [] if label not in members]
    if listed and len(others) < len(said["hidden"]) and len(re.split(r", | or ", listed[1])) > len(others):
        yield "hidden", f"called hidden beside the answer that it is part of: {listed[1]}"


def _ranked(said: Said) -> Iterator[tuple[str, str]]:
    """A verdict without a rival beside a table in which others have the better score; or another rank than there."""
    named = {f"{e['name']}@{e['where']}" for e in said["effects"]}
    ranks = [k for k, c in enumerate(said["candidates"], 1) if named and set(c["effects"]) == named]
    quoted = re.search(r"held-out score alone ranks it (\d+) of", text_of(said))
    if quoted and int(quoted[1]) not in ranks:
        yield "rank", f"ranks {quoted[1]}, in the table {ranks}"
    behind = said["candidates"][0]["score"] - said["candidates"][ranks[0] - 1]["score"] if ranks else 0.0
    alike = re.search(rf"Ahead by the held-out score: (\d+) .* at most ({NUMBER}) % more", text_of(said))
    if alike and (int(alike[1]) >= ranks[0] or max(_further(said)) > RELEVANT):
        yield "rank", f"{alike[1]} sets are said to be ahead with an irrelevant share, {_further(said)} in the table"
    if behind >= CLEARLY and "Probability among" in text_of(said) and not (quoted or alike):
        yield "rank", f"the most probable set is number {ranks[0]} of the table, and no sentence says so"


def _larger(said: Said) -> Iterator[tuple[str, str]]:
    """Sets with further effects that have most of the probability, beside a sentence that gives it to the named."""
    whole = _with_more(said)
    own = ((said.get("basis") or {}).get("probability") or {}).get("answer", math.inf)
    if 2 * whole > 1.02 * own and "for this one," in text_of(said) and "as well have" not in text_of(said):
        yield "larger", f"{whole:.3g} of the probability is that of larger sets"


def _ways(said: Said) -> Iterator[tuple[str, str]]:
    """A lag of the effort, which is the command's way, where only the measurement was found late."""
    names = {e["name"] for e in said["effects"]}
    if any(n.startswith("sensor_") for n in names) and not any(n.startswith(("actuator_", "command_")) for n in names):
        for sentence in said["sentences"]:
            if re.search(r"effort at \S+ acts .* later", sentence):
                yield "place", f"the measurement is late, but: {sentence}"


def main(paths: list[str]) -> None:
    kinds: Counter[str] = Counter()
    files = 0
    for path in paths:
        said = json.loads(Path(path).read_text())
        said = said.get("said", said)
        details = Path(path).with_name("details.json")  # has the shares of the black boxes
        more = json.loads(details.read_text()).get("black_boxes") if details.is_file() else None
        found = contradictions(said | {"black_boxes": more})
        files += bool(found)
        kinds.update(kind for kind, _ in found)
        for kind, text in found:
            print(f"{path}: {kind}: {text}")
    print(f"{sum(kinds.values())} contradictions in {files} of {len(paths)} results: {dict(kinds)}")


if __name__ == "__main__":
    main(sys.argv[1:])
