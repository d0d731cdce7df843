"""One blind case: hidden effect of a given strength, wrong base parameters, logs; its truth goes under seal."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bayessim_mjx import atomic
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.amounts import amount_of
from bayessim_mjx.blind.check import WIDEST, Bench, Check
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
