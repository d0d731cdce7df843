"""The cases of `count_intervals.py`, fixed before any was looked at: data sheets of any accuracy, and few or poor logs.

**Data sheets** (150 cases): seeds 9300 to 9314 of the pendulum, the cart-pole and the two-link arm, 9300 to 9309 of
both six-joint arms and the leg; a single and a double of each. Effects take turns as in `blind.py`, medium and strong.
Each mass, damping and armature of the real robot (all that these models' data sheets list) is 1 + scale N(0, 1) times
the nominal one, and no less than a tenth of it. The scale of a case is drawn log-uniformly from 2 to 30 %.

**Logs** (60 cases, 10 of each kind of POOR): singles, medium and strong, scale 5 %, seeds 9400 to 9459. Robots take
turns: pendulum, cart-pole, two-link arm and leg twice, the arms once; a joint is held on the two-link arm and the leg
four times each, and on the torque arm twice.

- held joint: a stiff servo (of the model too) holds one joint; its encoder of 12 bits shows one number throughout. The
  hidden effect is elsewhere.
- one log, two logs: of the runs 2 to 6 one, or two in different conditions.
- position-only: all runs, no velocities.
- quantised: steps of encoders of four standard deviations of their noise, stated nowhere.
- late velocities: measured velocities are those of 20 ms before.

**Nothing of the library** (90 cases): nothing hidden, seeds 9600 to 9609 of each robot, and one cause that the library
does not have (`KINDS`' unknown), seeds 9600 to 9604; the scale is drawn as above.

Velocities are logged in half of the others.

**Other realities** (60 cases each; the cases above are simulated by MuJoCo C at a tenth of the model's step). Of each
robot three singles and three doubles, two nulls and two unknown causes; strengths, scales and all else as for data
sheets. Fixed before any was simulated:

- own laws, seeds 9700 to 9702 (nulls and unknown causes 9700 and 9701): MuJoCo C with `own_laws.py` in place of seven
  causes' laws. These seven take turns in the singles, and as the first of two in the doubles, where they take that of
  the seed three turns later. The second is of all effects, as it is drawn for data sheets: the first of its pair that
  is another effect, and not a second body behind the same rotor.
- own integrator, seeds 9800 to 9802 (9800 and 9801): equations of motion and Runge-Kutta steps of .1 ms that are not
  MuJoCo's (`own_motion.py`), effects in turn as for data sheets. Strengths are those that MuJoCo C measures.

**Frozen** (60 of the cases of MuJoCo C): of each robot the first three singles and doubles of data sheets, two poor
logs, one null and one unknown cause. `frozen.json` has what a commit said of those that ended (`frozen.py`).
"""

import dataclasses
import functools
import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import own_laws
from cases import KNOWN, STRENGTHS, SYSTEMS, draw_cause, places, write
from isolable import KINDS, seed_of
from turns import jobs

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.lookalikes import APART, isolable, record, rivals
from bayessim_mjx.blind.reality.plant import Plant, Run, base_names, scales_of
from bayessim_mjx.blind.reality.strength import Ruler, resize
from bayessim_mjx.blind.reality.system import RUNS, System

SMALL, LARGE = ("pendulum", "cartpole", "two_link"), ("leg", "arm_servo", "arm_torque")
SEEDS = {**dict.fromkeys(SMALL, range(9300, 9315)), **dict.fromkeys(LARGE, range(9300, 9310))}
SCALES = 0.02, 0.30  # ends of the scale of parameter errors
STATED = 0.05  # the scale of the cases of poor logs: what the diagnosis assumes
LEAST = 0.1  # of a nominal value: the smallest that a real one is
WIDEST = 3.0  # scales, within which a refit may move known parameters when an effect's strength is measured
FREE = 0.9  # of their nominal values, within which they are free where rivals are sought: no accuracy is stated

OUTSIDE = {"null": range(9600, 9610), "unknown": range(9600, 9605)}

OTHERS = {"own laws": 9700, "own integrator": 9800}  # first seeds
EACH = {"single": 3, "double": 3, "null": 2, "unknown": 2}  # of each robot in each of them

FROZEN = {"single": 3, "double": 3, "logs": 2, "null": 1, "unknown": 1}  # of each robot, the first of each

POOR = ("held joint", "one log", "two logs", "position-only", "quantised", "late velocities")
POOR_SEED = 9400
TURNS = ("pendulum", "cartpole", "two_link", "leg") * 2 + ("arm_servo", "arm_torque")
HELD_TURNS = ("two_link", "leg") * 4 + ("arm_torque",) * 2
HELD = {"two_link": ("elbow", 4000, 40), "leg": ("knee", 4000, 40), "arm_torque": ("flange", 2000, 20)}  # joint, kp, kv
EXAMINED = Path(__file__).with_name("isolable.json")
COUNT = 2 * np.pi / 4096  # rad, of the held joint's encoder
CHOSEN = range(2, 7)  # runs of which few are logged: none is slow or without a controller
STEPS = 4.0  # standard deviations of noise, of quantised encoders
LATE = 0.02  # s


@dataclasses.dataclass(frozen=True)
class Plan:
    """One case before anything of it is simulated.

    logs: "all", or one of POOR; scale: of its parameters' errors; reality: "mujoco", or one of OTHERS.
    """

    name: str
    logs: str
    kind: str
    system: str
    effects: tuple[str, ...]
    strength: str
    seed: int
    scale: float
    reality: str = "mujoco"

    @property
    def group(self) -> str:
        """ "sheets", "logs", or "outside"."""
        return "logs" if self.logs != "all" else "outside" if self.kind in OUTSIDE else "sheets"


@functools.cache
def plans() -> tuple[Plan, ...]:
    """All cases, those of data sheets first."""
    found = []
    for system, seeds in SEEDS.items():
        found += [_drawn_sheet(*job) for job in jobs(Path(), seeds, KINDS[:2], [system], [*STRENGTHS][1:3])]
    for system in SEEDS:
        own = {}
        for (i, logs), (j, turn) in itertools.product(enumerate(POOR), enumerate(TURNS)):
            if (HELD_TURNS[j] if logs == "held joint" else turn) == system:
                own[POOR_SEED + len(TURNS) * i + j] = logs
        for kind, _, effects, strength, seed, _ in jobs(Path(), own, KINDS[:1], [system], [*STRENGTHS][1:3]):
            name = f"{system}_{own[seed].replace(' ', '_')}_s{seed}"
            found.append(Plan(name, own[seed], kind, system, effects, strength, seed, STATED))
    for system, (kind, seeds) in itertools.product(SEEDS, OUTSIDE.items()):
        found += [_drawn_sheet(*job) for job in jobs(Path(), seeds, [kind], [system], [*STRENGTHS][1:3])]
    return (*found, *_in_other_realities())


def _in_other_realities() -> Iterator[Plan]:
    for (reality, first), system, (kind, count) in itertools.product(OTHERS.items(), SEEDS, EACH.items()):
        for job in jobs(Path(), range(first, first + count), [kind], [system], [*STRENGTHS][1:3]):
            plan = dataclasses.replace(_drawn_sheet(*job), reality=reality)
            if reality == "own laws":
                plan = dataclasses.replace(plan, effects=own_laws.turn(kind, system, plan.seed, plan.effects))
            yield plan


@functools.cache
def frozen() -> tuple[Plan, ...]:
    """The cases that every change of the diagnosis is held against."""
    taken: Counter[tuple[str, str]] = Counter()
    found = []
    for plan in (p for p in plans() if p.reality == "mujoco"):
        kind = plan.system, "logs" if plan.group == "logs" else plan.kind
        taken[kind] += 1
        found += [plan] if taken[kind] <= FROZEN[kind[1]] else []
    return tuple(found)


def _drawn_sheet(kind: str, system: str, effects: tuple[str, ...], strength: str, seed: int, _: Path) -> Plan:
    """A case with all logs, whose data sheet is as inexact as is drawn."""
    low, high = map(math.log, SCALES)
    scale = math.exp(np.random.default_rng((seed, KINDS.index(kind), *system.encode())).uniform(low, high))
    return Plan(f"{system}_{kind}_s{seed}", "all", kind, system, effects, strength, seed, scale)


@dataclasses.dataclass(frozen=True)
class Held(System):
    """A robot one of whose joints a stiff servo of its own holds at a count of its encoder.

    held: index of the joint and of its actuator.
    """

    held: int = 0

    @property
    def angle(self) -> float:
        return float(COUNT * round(self.centre[self.held] / COUNT))

    def _plan(self, plant: Plant, index: int, seed: int) -> tuple[Callable[..., np.ndarray], np.ndarray, np.ndarray]:
        control, start, speed = super()._plan(plant, index, seed)
        start[self.held], speed[self.held] = self.angle, 0.0

        def holding(*seen: Any) -> np.ndarray:
            u = control(*seen)
            u[self.held] = self.angle
            return u

        return holding, start, speed


def robot_of(plan: Plan) -> System:
    """The case's robot as modelled."""
    robot = SYSTEMS[plan.system]
    if plan.logs != "held joint":
        return robot
    joint, kp, kv = HELD[plan.system]
    spec = robot.spec()
    held = [j.name for j in spec.joints].index(joint)
    old = next(line for line in robot.xml.splitlines() if f'name="{joint}_motor"' in line)
    xml = robot.xml.replace(old, f'    <position name="{joint}_motor" joint="{joint}" kp="{kp}" kv="{kv}"/>')
    swing = tuple(0.0 if i == held else s for i, s in enumerate(robot.swing))
    own = {f.name: getattr(robot, f.name) for f in dataclasses.fields(System)}
    return Held(**own | {"xml": xml, "swing": swing}, held=held)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A case's robot, real parameters and causes (without their sizes), the ruler of strengths, what is drawn next."""

    robot: System
    base: dict[str, float]
    causes: list[Cause]
    ruler: Ruler
    rng: np.random.Generator
    reality: str

    def plant(self) -> Plant:
        if self.reality != "own integrator":
            return Plant(self.robot, self.base, self.causes)
        from own_plant import OwnPlant  # JAX, which the other realities do without

        return OwnPlant(self.robot, self.base, self.causes)


def errors(plan: Plan, names: Sequence[str], rng: np.random.Generator) -> dict[str, float]:
    """Real values of known parameters, in nominal ones."""
    return {n: max(1 + plan.scale * float(rng.normal()), LEAST) for n in names}


def drawn(plan: Plan) -> Drawn:
    robot, seed = robot_of(plan), seed_of(plan.kind, plan.seed)
    rng = np.random.default_rng((seed, *plan.system.encode()))
    base = errors(plan, base_names(robot.spec().compile()), rng)
    ruler = Ruler(robot, base, WIDEST * plan.scale, seed)
    scales, causes = scales_of(ruler.plain, ruler.runs), list[Cause]()
    still = HELD[plan.system][0] if isinstance(robot, Held) else ""
    for name in plan.effects:
        open_to = [w for w in places(robot, name, scales) if scales.drives.get(w, w) != still]
        effect = (name, str(rng.choice(open_to))) if still else name
        cause = draw_cause(effect, robot, scales, causes, rng)
        causes.append(own_laws.lawful(cause) if plan.reality == "own laws" else cause)
    return Drawn(robot, base, causes, ruler, rng, plan.reality)


def sized(plan: Plan) -> tuple[Drawn, list[dict[str, Any]]]:
    """A case with its causes as strong as planned, and what `truth.json` says of each."""
    case, truths = drawn(plan), []
    for cause in case.causes:
        raw, left = resize(cause, case.ruler, STRENGTHS[plan.strength])
        own = {"name": cause.name, "where": cause.where, "parameters": cause.parameters(), "size": cause.size}
        truths.append(own | {"raw": raw, "left": left})
    return case, truths


def make(plan: Plan, out: Path) -> dict[str, Any]:
    """Write model, logs and truth of a case; the truth."""
    case, truths = sized(plan)
    velocity = plan.logs == "late velocities" or bool(case.rng.uniform() < 0.5 and plan.logs != "position-only")
    truth = dataclasses.asdict(plan) | {"velocity": velocity, "base": case.base, "effects": truths}
    plant = case.plant()
    runs = [case.robot.record(plant, i, seed_of(plan.kind, plan.seed)) for i in range(len(RUNS))]
    if not all(np.isfinite(r.clean).all() for r in runs):
        raise RuntimeError(f"{plan.name}: the motion does not stay finite")
    write(out, case.robot, logged(plan, case.robot, runs, case.rng), truth)
    if isinstance(case.robot, Held):  # one of the actuators is a servo: commands go to them as they are
        for told in (out / "logs").glob("*.yaml"):
            told.write_text("\n".join(line for line in told.read_text().splitlines() if "law" not in line) + "\n")
    return truth


def again(plan: Plan, truth: dict[str, Any]) -> Drawn:
    """A written case with its causes of the sizes that they have there."""
    case = drawn(plan)
    for cause, told in zip(case.causes, truth["effects"], strict=True):
        cause.size = told["size"]
    return case


def rivals_of(plan: Plan, truth: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Of each hidden effect {"left": encoder noises that known parameters leave of it, "rivals": see `rivals`}.

    As if it were there alone, by all motions in MuJoCo C, however few the case logs. Without a truth that was written
    the sizes are sought anew.
    """
    case = sized(plan)[0] if truth is None else again(plan, truth)
    ruler = Ruler(case.robot, case.base, FREE, seed_of(plan.kind, plan.seed))
    found = []
    for cause in case.causes:
        left = ruler.measure(record(cause, ruler))[1]
        found.append({"left": left, "rivals": rivals(cause, ruler, KNOWN)})
    return found


def each_isolable(found: Sequence[dict[str, Any]]) -> bool:
    """Whether known parameters leave something of each hidden effect, and every rival of it does."""
    return all(f["left"] >= APART and isolable(f["rivals"], f["left"]) for f in found)


@functools.cache
def examined() -> dict[str, list[dict[str, Any]]]:
    """What `rivals_of` found of each case, with the closest rival alone: a case is the same for every commit."""
    return dict(json.loads(EXAMINED.read_text()))


def keep(out: Path) -> int:
    """Add the cases that were examined in a folder to those of `examined`, one case a line; how many there are."""
    own = {f.parent.name: json.loads(f.read_text()) for f in out.glob(f"*/{EXAMINED.name}")}
    closest = {name: [f | {"rivals": f["rivals"][:1]} for f in found] for name, found in own.items()}
    every = (examined() if EXAMINED.exists() else {}) | closest
    rounded = {n: json.loads(json.dumps(f), parse_float=lambda x: round(float(x), 3)) for n, f in sorted(every.items())}
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(found)}" for name, found in rounded.items())
    EXAMINED.write_text(f"{{\n{lines}\n}}\n")
    return len(every)


def logged(plan: Plan, robot: System, runs: Sequence[Run], rng: np.random.Generator) -> list[Run]:
    """What of the runs stands in the logs."""
    out = list(runs)
    if plan.logs == "one log":
        return [out[int(rng.choice(CHOSEN))]]
    if plan.logs == "two logs":
        one, two = 0, 0
        while RUNS[one][0] == RUNS[two][0]:
            one, two = sorted(int(i) for i in rng.choice(CHOSEN, 2, replace=False))
        return [out[one], out[two]]
    if plan.logs == "quantised":
        step = STEPS * np.asarray(robot.sigma)
        return [dataclasses.replace(r, qpos=step * np.round(r.qpos / step)) for r in out]
    if plan.logs == "late velocities":
        rows = round(LATE / robot.period)
        return [dataclasses.replace(r, qvel=np.concatenate([r.qvel[:1]] * rows + [r.qvel[:-rows]])) for r in out]
    if isinstance(robot, Held):
        for r in out:
            r.qpos[:, robot.held] = COUNT * np.round(r.clean[:, robot.held] / COUNT)
    return out
