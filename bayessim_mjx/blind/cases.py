"""One blind case: hidden effect of a given strength, wrong base parameters, logs; its truth goes under seal."""

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bayessim_mjx import atomic
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.amounts import amount_of
from bayessim_mjx.blind.check import WIDEST, Bench, Check
from bayessim_mjx.blind.curves import Curves, Group, Trial
from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.lookalikes import record
from bayessim_mjx.blind.reality.menu import CAUSES
from bayessim_mjx.blind.reality.plant import Plant, Rig, Run, base_names
from bayessim_mjx.blind.reality.replay import Replay
from bayessim_mjx.blind.reality.strength import HIDDEN, resize
from bayessim_mjx.logs import Channels

# choices, by no measurement
GIVE_UP = 4  # times that an effect is halved because the motion does not stay finite
EFFORT_NOISE = 0.01  # of its root mean square (docs/blind.md)


@dataclasses.dataclass(frozen=True)
class Item:
    """What is hidden in a case: kind is single, unknown or null; strength in encoder noises."""

    index: int
    kind: str
    effect: str = ""
    where: str = ""
    strength: float = 0.0


ITEM = tuple(f.name for f in dataclasses.fields(Item))


def make(check: Check, bench: Bench, item: Item) -> None:
    """Write the logs of a case, its truth and its seal; a case that is whole stays as it is."""
    if check.seal(item.index).exists():
        return
    given = check.given(item.index)
    if given.exists():  # a killed run's
        shutil.rmtree(given)
    base, causes, rng = drawn(check, bench, item)
    effects = []
    for cause in causes:
        raw, left = resize(cause, bench.ruler, item.strength)
        effects.append({"raw": raw, "left": left})
    sizes = [c.size for c in causes]
    plant, runs = _moved(bench.rig, base, causes, seed=int(rng.integers(2**31)))
    if sizes != [c.size for c in causes]:
        raw, left = bench.ruler.measure(record(causes[0], bench.ruler))
        effects = [{"raw": raw, "left": left}]
    write_logs(given / "logs", bench.rig, runs, bench.velocity, bench.effort, rng)
    for cause, effect in zip(plant.causes, effects, strict=True):
        effect |= {"strength": min(effect["raw"], HIDDEN * effect["left"]), **hidden(cause)}
    truth = dataclasses.asdict(item) | {"seed": check.seed, "base": base, "effects": effects}
    salt = seal.digest(rng.bytes(32))
    code = seal.close(truth | {"salt": salt}, given, check.secret(item.index))
    atomic.write_text(check.seal(item.index), code)


def drawn(check: Check, bench: Bench, item: Item) -> tuple[dict[str, float], list[Cause], np.random.Generator]:
    """Draw (base parameters, the cause without its size, the generator of what is drawn after them) of a case."""
    rng = np.random.default_rng((check.seed, item.index))
    base = data_sheet(bench.rig, check.accuracy, rng)
    return base, [CAUSES[item.effect](item.where, bench.scales, rng)] if item.effect else [], rng


def again(check: Check, bench: Bench, item: Item, size: float) -> Cause:
    """Draw the hidden cause of a case again, at its size."""
    (cause,) = drawn(check, bench, item)[1]
    cause.size = size
    return cause


def data_sheet(rig: Rig, accuracy: float, rng: np.random.Generator) -> dict[str, float]:
    """Factors of masses, damping and armature: normal, within three standard deviations."""
    names = base_names(rig.spec().compile())
    return {n: 1 + accuracy * float(np.clip(rng.normal(), -WIDEST, WIDEST)) for n in names}


def hidden(cause: Cause) -> dict[str, Any]:
    """Describe a cause as the truth of a case."""
    parameters = {k: float(v) for k, v in cause.parameters().items()}
    amount = amount_of(cause.name, parameters)
    return {"name": cause.name, "where": cause.where, "parameters": parameters, "size": cause.size, "amount": amount}


def _moved(rig: Rig, base: dict[str, float], causes: list[Cause], seed: int) -> tuple[Plant, list[Run]]:
    """Move the plant in all runs, (plant, runs); a cause under which a long run does not stay finite is halved."""
    for _ in range(GIVE_UP + 1):
        plant = Plant(rig, base, causes)
        runs = [rig.record(plant, i, seed) for i in range(len(rig.labels))]
        if all(np.isfinite(r.clean).all() for r in runs):
            return plant, runs
        for cause in causes:
            cause.size = max(0.5 * cause.size, cause.smallest)
    raise RuntimeError(f"{rig.name}: the motion does not stay finite under {[c.name for c in causes]}")


def write_logs(folder: Path, rig: Rig, runs: list[Run], velocity: bool, effort: bool, rng: np.random.Generator) -> None:
    """CSV files and their side YAMLs in the library's format (docs/logs.md)."""
    folder.mkdir(parents=True)
    names = Channels.of(rig.spec().compile())
    for i, r in enumerate(runs):
        blocks = [("ctrl", names.actuators, r.ctrl), ("qpos", names.qpos, r.qpos)]
        blocks += [("qvel", names.qvel, r.qvel)] if velocity else []
        if effort and r.pull is not None:
            level = EFFORT_NOISE * np.sqrt(np.mean(r.pull**2, axis=0))
            blocks.append(("effort", names.actuators, r.pull + level * rng.normal(size=r.pull.shape)))
        header = ["time", *(f"{stream}:{n}" for stream, own, _ in blocks for n in own)]
        stem = folder / f"{i:02d}_{_plain(rig.labels[i])}"
        table = np.concatenate([r.time[:, None], *(values for *_, values in blocks)], 1)
        np.savetxt(stem.with_suffix(".csv"), table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
        stem.with_suffix(".yaml").write_text(yaml.safe_dump(_metadata(rig, i), sort_keys=False), encoding="utf-8")


def _metadata(rig: Rig, index: int) -> dict[str, Any]:
    label = rig.labels[index]
    own = dict(rig.takes[index].metadata) if isinstance(rig, Replay) else {}
    return {"condition": label, "operating_condition": label, **own}


def _plain(label: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in label)[:40]


# Which effect is hidden where, and how strong: rounds of cases, near where an effect begins to be found


# Which cases are made is a choice (docs/blind.md); it makes intervals wider or narrower, not wrong.
KINDS = "SSSNSSSSUN"  # single, null, unknown cause; over and over
FIRST, ROUND = 16, 8  # cases of the first round and of the others
BEHIND = 4  # rounds after which a round's outcomes count: the strengths of the first ones are spread widely
AT_ONCE = FIRST + (BEHIND - 1) * ROUND  # cases that need not wait for any other
SPREAD = (2.0, 40.0)  # encoder noises, of the first rounds
SHARES = (0.5, 0.9)  # how often later strengths are expected to be found
RANGE = (0.5, 500.0)  # encoder noises, of all rounds


def rounds(cases: int) -> list[range]:
    """Split the indices of the cases into rounds."""
    starts = [0, *range(FIRST, cases, ROUND)]
    return [range(a, min(b, cases)) for a, b in zip(starts, [*starts[1:], cases], strict=True)]


def known(own: range) -> int:
    """How many cases have to be finished before those of a round are planned: the first ones of all."""
    turns = rounds(own.start)
    return turns[-BEHIND].stop if len(turns) >= BEHIND else 0


def plan(
    own: range, groups: Sequence[Group], unknown: Sequence[Group], trials: Sequence[Trial], seed: int
) -> list[Item]:
    """Make the items of a round.

    Args:
        own: indices of its cases; groups, unknown: (effect, place) of what may be hidden, and of what no library has.
        trials: outcomes of the `known` cases; seed: of the check.
    """
    curves = Curves(trials) if trials else None
    out = []
    for index in own:
        kind = KINDS[index % len(KINDS)]
        if kind == "N" or (kind == "U" and not unknown):
            out.append(Item(index, "null"))
            continue
        turn = sum(KINDS[i % len(KINDS)] == kind for i in range(index))
        effect, where = in_turn(groups if kind == "S" else unknown, turn, seed)
        strength = _strength(curves, effect, where, turn, np.random.default_rng((seed, index, 1)))
        out.append(Item(index, "single" if kind == "S" else "unknown", effect, where, strength))
    return out


def in_turn(groups: Sequence[Group], turn: int, seed: int) -> Group:
    """Effects take turns, and so do the places of each."""
    rng = np.random.default_rng((seed, 2))
    effects = [str(e) for e in rng.permutation(sorted({e for e, _ in groups}))]
    effect = effects[turn % len(effects)]
    places = [str(w) for w in rng.permutation(sorted(w for e, w in groups if e == effect))]
    return effect, places[turn // len(effects) % len(places)]


def _strength(curves: Curves | None, effect: str, where: str, turn: int, rng: np.random.Generator) -> float:
    low, high = SPREAD
    if curves is None:
        share = (0.5 + turn * 0.6180339887) % 1.0  # evenly spread, however many there are
        return float(low * (high / low) ** share)
    drawn = curves.of(effect, where).draw(rng, rng.uniform(*SHARES))
    return float(np.clip(drawn, *RANGE))
