"""A robot and an experimenter who moves it through the menu of motions, by its servo or by a PD controller outside."""

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.plant import Plant, Run

QUANTUM = 2 * np.pi / 16384  # rad, of an encoder of 14 bits
# a choice of what experimenters do; the cases of benchmarks/diagnosis have the same
SECONDS = 4.0
RISE = 0.25  # s, of a step, so that a step needs an effort that drives have
# (operating condition, profile, amplitude and pace as multiples of the system's)
RUNS = (
    ("slow_triangle", "triangle", 1.0, 0.35),
    ("slow_triangle", "triangle", 0.35, 0.6),
    ("multisine", "multisine", 1.0, 1.0),
    ("multisine", "multisine", 0.4, 1.8),
    ("chirp", "chirp", 0.7, 1.0),
    ("steps", "steps", 0.6, 1.0),
    ("steps", "steps", 1.0, 1.6),
    ("open_loop", "multisine", 1.0, 1.0),
)
Reference = Callable[[float], np.ndarray]


@dataclasses.dataclass(frozen=True)
class System:
    """A robot without effects and what an experimenter does with it.

    Attributes:
        xml: the nominal model. Bodies that move carry geoms with stated masses; `base` is fixed and massive.
        period: s, of log and outer controller.
        servo: actuators take position targets (in the model's own servo); else torques of an outer PD controller.
        kp, kd: of the outer controller, N m/rad and N m s/rad (N/m, N s/m) per actuator.
        centre, swing: rad or m per actuator, of the reference motion; push: share of the command range in open loop.
        lift: rad, how far off the reference the driven joints start, so that a foot starts above the floor.
        pace: Hz, of the reference motion.
        sigma: rad or m per joint, noise of the encoders.
        base: the body that stands on the ground; tilts: whether a tilt of the ground, or its give, makes sense;
            load: gives the model where there is no `xml`.
    """

    name: str
    xml: str
    period: float
    servo: bool
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    centre: tuple[float, ...]
    swing: tuple[float, ...]
    pace: float
    sigma: tuple[float, ...]
    push: float = 0.25
    lift: float = 0.0
    base: str = "base"
    tilts: bool = True
    load: Callable[[], mujoco.MjSpec] | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(label for label, *_ in RUNS)

    @property
    def pushed(self) -> tuple[int, ...]:
        return (0, 2, 4, 6)

    @property
    def touching(self) -> tuple[str, ...]:
        return ("foot",) if 'name="foot"' in self.xml else ()

    def spec(self) -> mujoco.MjSpec:
        return self.load() if self.load else mujoco.MjSpec.from_string(self.xml)

    def record(self, plant: Plant, index: int, seed: int, noise: bool = True) -> Run:
        """Run `index` of RUNS: the outer controller sees noisy encoders, as the log does."""
        model = plant.model
        rng = np.random.default_rng((seed, index))  # noise; the motion is that of the system and the run
        control, start, speed = self._plan(plant, index, seed)
        sigma, rows = np.asarray(self.sigma), round(SECONDS / self.period) + 1
        quantum = QUANTUM * (rng.uniform() < 0.5)
        plant.reset(start, speed, control(0.0, start, speed))
        record: dict[str, list[np.ndarray]] = {k: [] for k in ("ctrl", "qpos", "qvel", "clean", "clean_v", "pull")}
        effort, pull = np.zeros(len(plant.joints)), np.zeros(model.nu)
        for row in range(rows):
            clean, clean_v = plant.measure()
            q = clean + noise * sigma * rng.normal(size=len(sigma))
            v = clean_v + noise * 20 * sigma * rng.normal(size=len(sigma))
            if noise and quantum:
                q = quantum * np.round(q / quantum)
            u = control(row * self.period, q, v)
            for key, value in zip(record, (u, q, v, clean, clean_v, pull), strict=True):
                record[key].append(value)
            plant.advance(u)
            effort, pull = np.maximum(effort, plant.force()), plant.data.actuator_force.copy()
        stacked = {k: np.array(v) for k, v in record.items()}
        return Run(time=np.arange(rows) * self.period, **stacked, effort=effort, index=index)

    def repeat(self, plant: Plant, run: Run, row: int) -> None:
        """From a row of a run to the next."""
        plant.advance(run.ctrl[row])

    def _plan(self, plant: Plant, index: int, seed: int) -> tuple[Callable[..., np.ndarray], np.ndarray, np.ndarray]:
        """Plan a run: (controller of time, position and velocity; start state)."""
        model = plant.model
        _, profile, size, pace = RUNS[index]
        plan = np.random.default_rng((seed, index, 1))
        target = reference(profile, size * np.asarray(self.swing), pace * self.pace, plan)
        extra = reference("multisine", np.ones(model.nu), 1.3 * self.pace, plan)
        free = RUNS[index][0] == "open_loop" and not self.servo
        driven = [plant.column(model.joint(i).name) for i in model.actuator_trnid[:, 0]]
        limit = model.actuator_ctrlrange[:, 1] if not self.servo else np.full(model.nu, np.inf)
        centre = np.asarray(self.centre)

        def control(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            if self.servo:
                return centre + target(t)
            goal = centre + (0 if free else target(t))
            rate = 0 if free else (target(t + 5e-3) - target(t - 5e-3)) / 1e-2
            soft = (0.0 if len(plant.joints) < 3 and model.nu == 1 else 0.2) if free else 1.0
            u = soft * (np.asarray(self.kp) * (goal - q[driven]) + np.asarray(self.kd) * (rate - v[driven]))
            return np.clip(u + (self.push * limit * extra(t) if free else 0), -limit, limit)

        start, speed = np.zeros((2, len(plant.joints)))
        start[driven] = centre + self.lift + (0 if free else target(0.0))
        speed[driven] = 0 if free else (target(5e-3) - target(-5e-3)) / 1e-2
        return control, start, speed


def reference(profile: str, amplitude: np.ndarray, pace: float, rng: np.random.Generator) -> Reference:
    """Motion around zero, `[n]` at any time: joints at different paces and phases, so that they can be separated."""
    n = len(amplitude)
    paces = pace * rng.uniform(0.75, 1.25, n)
    phases = rng.uniform(0, 1, n)
    if profile == "triangle":

        def at(t: float) -> np.ndarray:
            s = (paces * t + phases) % 1.0
            wave = 4 * np.abs(s - 0.5) - 1
            return amplitude * np.clip(1.25 * wave, -1, 1)  # rests at both ends
    elif profile == "multisine":
        harmonics = np.outer([0.5, 1.0, 1.7, 2.9], paces)
        shares = np.array([0.45, 0.4, 0.25, 0.12])[:, None]
        shift = rng.uniform(0, 2 * np.pi, harmonics.shape)

        def at(t: float) -> np.ndarray:
            return amplitude * (shares * np.sin(2 * np.pi * harmonics * t + shift)).sum(0)
    elif profile == "chirp":

        def at(t: float) -> np.ndarray:
            rate = 0.3 * t + (3.0 - 0.3) * t * t / (2 * SECONDS)  # 0.3 to 3 times the pace
            return amplitude / (1 + 0.35 * t) * np.sin(2 * np.pi * (paces * rate + phases))
    else:
        levels = rng.uniform(-1, 1, (64, n))

        def at(t: float) -> np.ndarray:
            count = np.maximum(t * paces * 1.5 + phases, 0.0)
            whole = count.astype(int)
            s = np.clip((count - whole) / (1.5 * paces * RISE), 0, 1)
            old, new = levels[whole, np.arange(n)], levels[whole + 1, np.arange(n)]
            return amplitude * (old + (new - old) * s * s * (3 - 2 * s))

    return at
