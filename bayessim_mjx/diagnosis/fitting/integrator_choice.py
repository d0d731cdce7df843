"""The integrator and the time step of a diagnosis: the coarsest stable step, and RK4 where sub-steps do not suffice.

Stability is that of the model linearised by MuJoCo at states of the logs, without contacts and limits: the solver keeps
those stable by itself. Stiff springs, servo loops and nearly massless axes need fine steps.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.discretisation import Discretisation
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.fitting.scales import mass_matrix
from bayessim_mjx.diagnosis.fitting.simulable import contacts
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.physics import controllers
from bayessim_mjx.physics.timestep import STAGES

Array = NDArray[np.float64]
# (robot's physics, first=coarsest stable factor, cheaper=see `Errors`) -> (the windows, the error of the time step)
Measured = Callable[..., tuple[Any, Discretisation]]
TOO_LONG = "the model's time step shows beside the noise, and in the time given nothing finer can be searched with"
EULER, RK4, IMPLICITFAST = (int(getattr(mujoco.mjtIntegrator, f"mjINT_{n}")) for n in ("EULER", "RK4", "IMPLICITFAST"))


@dataclass(frozen=True)
class Rules:
    """When a step is stable, and how fine one is looked for. Rules of thumb, not counted."""

    finest: int = 64  # sub-steps per step of the model
    states: int = 8  # of all logs, at which the model is linearised
    nudge: float = 1e-5  # rad or rad/s, of the finite differences
    growth: float = 1.05  # per step, beyond what the motion itself grows by (a pendulum that falls over)


RULES = Rules()


@dataclass(frozen=True)
class Step:
    """The coarsest stable step.

    Attributes:
        timestep: s, the model's.
        factor: sub-steps of the diagnosis are at most `timestep / factor`.
        integrator: MuJoCo's number of the one to use; changed: it is not the model's.
        joint: which asks for it; "" where the model's own step is stable.
        reached: whether any step up to the finest is stable.
    """

    timestep: float
    factor: int
    integrator: int
    changed: bool
    joint: str
    reached: bool

    def robot(self, robot: Robot) -> Robot:
        """The robot with the integrator."""
        if not self.changed:
            return robot
        return _integrated(robot, self.integrator)

    def sentences(self) -> list[str]:
        """Sentences for the user before anything is fitted."""
        if not self.joint:
            return []
        own, finer = 1e3 * self.timestep, 1e3 * self.timestep / self.factor
        text = (
            f"the simulator is unstable at its time step of {own:.3g} ms: {self.joint} is too stiff or too light for it"
        )
        if not self.reached:
            mend = "more armature or damping, or a softer loop, at this joint would"
            return [f"{text}, and for {finer:.3g} ms too; no gap can be trusted there ({mend})"]
        how = " by the integrator implicitfast" if self.changed else ""
        return [f"{text}; the diagnosis simulates at {finer:.3g} ms or less{how}"]


def coarsest_stable(model: mujoco.MjModel, logs: Sequence[Log]) -> Step:
    """The coarsest stable step of a model, with its own integrator, or with implicitfast where that may be coarser."""
    own, h = int(model.opt.integrator), float(model.opt.timestep)
    cases = list(_linearised(model, logs))
    kinds = [own] + [IMPLICITFAST] * (own != IMPLICITFAST)
    factors = {kind: max((_factor(case, kind, h) for case in cases), default=1) for kind in kinds}
    best = min(kinds, key=lambda kind: (factors[kind], kind != own))
    factor = factors[best]
    joint = "" if factors[own] == 1 else _joint(model, cases, own, h)
    return Step(h, min(factor, RULES.finest), best, best != own, joint, factor <= RULES.finest)


@dataclass(frozen=True)
class Choice:
    """How the robot is simulated.

    Attributes:
        robot: with the integrator of the diagnosis; stable: its coarsest stable step.
        cuts, worth: the windows, and the error of the time step in them.
        better: told where the integrator was changed for its accuracy.
    """

    robot: Robot
    stable: Step
    cuts: Any
    worth: Discretisation
    better: tuple[str, ...] = ()

    def said(self) -> list[str]:
        """Sentences for the user before anything is fitted."""
        return [*self.stable.sentences(), *self.better, *self.worth.beyond()]

    def warnings(self) -> list[str]:
        """What the model's own step costs, where it can be simulated at all."""
        return self.worth.warnings() if self.stable.factor == 1 else []


def choose(
    robot: Robot,
    dt: float,
    logs: Sequence[Log],
    measured: Measured,
    left: float = np.inf,
) -> Choice:
    """The coarsest stable step; where what no sub-steps remove shows, and nothing can touch, RK4.

    It would count as noise else, and in a noise that is larger than the sensors' what two integrators differ by (a
    fraction of a millisecond, usually) is found as an effect.

    Args:
        left: s that one simulation of all windows may take, for the search to end in time.
    """
    stable = coarsest_stable(robot.physics(dt).mj_model, logs)
    robot = stable.robot(robot)
    own = robot.physics(dt)
    plain = Choice(robot, stable, *measured(own, first=stable.factor))
    if not (plain.worth.beyond() or plain.worth.shows):
        return plain
    if contacts(own) or int(own.mj_model.opt.integrator) == RK4:
        return plain
    if plain.worth.errors and (len(STAGES) + 1) * plain.worth.errors.seconds >= left:
        return dataclasses.replace(plain, better=(TOO_LONG,))
    other = _integrated(robot, RK4)
    physics = other.physics(dt)
    needs = coarsest_stable(physics.mj_model, logs)
    if needs.changed or not needs.reached:
        return plain
    found = measured(physics, first=needs.factor, cheaper=plain.worth.errors)
    if found[1].nats > plain.worth.nats:
        return plain
    step = 1e3 * found[1].timestep / found[1].factor
    text = f"the diagnosis simulates by RK4 at {step:.3g} ms: sub-steps of the model's integrator show in the evidence"
    return Choice(other, dataclasses.replace(needs, joint=stable.joint), *found, better=(text,))


def _integrated(robot: Robot, integrator: int) -> Robot:
    model = copy.copy(robot.mj_model)
    model.opt.integrator = integrator
    return dataclasses.replace(robot, mj_model=model)


@dataclass(frozen=True)
class _Linear:
    """Accelerations per position and per velocity `[nv, nv]`; of the latter what each integrator treats implicitly."""

    position: Array
    velocity: Array
    implicit: dict[int, NDArray[np.floating]]

    def stepped(self, kind: int, h: float) -> Array:
        """One step of h s: (q, v) -> (q, v), `[2 nv, 2 nv]`."""
        n = len(self.position)
        one, nothing = np.eye(n), np.zeros((n, n))
        if kind == RK4:
            A = h * np.block([[nothing, one], [self.position, self.velocity]])
            return np.asarray(
                np.eye(2 * n) + A @ (np.eye(2 * n) + A @ (np.eye(2 * n) + A @ (np.eye(2 * n) + A / 4) / 3) / 2)
            )
        explicit = self.velocity - self.implicit[kind]
        inverse = np.linalg.inv(one - h * self.implicit[kind])
        speed = np.hstack([h * inverse @ self.position, inverse @ (one + h * explicit)])
        return np.vstack([np.hstack([one, nothing]) + h * speed, speed])

    def grows(self) -> float:
        """1/s, by which the motion itself grows."""
        n = len(self.position)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [self.position, self.velocity]])
        return max(float(np.linalg.eigvals(A).real.max()), 0.0)

    def stable(self, kind: int, h: float) -> bool:
        G = self.stepped(kind, h)
        return bool(np.isfinite(G).all()) and _radius(G) < RULES.growth * np.exp(min(self.grows() * h, 50.0))


def _radius(G: Array) -> float:
    return float(np.abs(np.linalg.eigvals(G)).max())


def _factor(case: _Linear, kind: int, h: float) -> int:
    factor = 1
    while factor <= RULES.finest and not case.stable(kind, h / factor):
        factor *= 2
    return factor


def _joint(model: mujoco.MjModel, cases: Sequence[_Linear], kind: int, h: float) -> str:
    """The dof that moves most in the mode that grows fastest."""
    worst = max((case.stepped(kind, h) for case in cases), key=_radius)
    values, modes = np.linalg.eig(worst)
    mode = np.abs(modes[model.nv :, int(np.argmax(np.abs(values)))])
    return Channels.of(model).qvel[int(np.argmax(mode))]


def _linearised(model: mujoco.MjModel, logs: Sequence[Log]) -> Iterator[_Linear]:
    laws = controllers.of_logs(logs, model)
    each = max(1, RULES.states // max(len(logs), 1))
    for i, log in list(enumerate(logs))[: RULES.states]:
        law = None if laws is None else jax.tree.map(lambda x, i=i: np.asarray(x[i]), laws)
        for row in np.linspace(0, len(log) - 1, each + 2).astype(int)[1:-1]:
            yield _at(model, log.qpos[row], log.qvel[row], log.ctrl[row], law)


def _at(model: mujoco.MjModel, qpos: Array, qvel: Array, command: Array, law: controllers.Law | None) -> _Linear:
    data, nv = mujoco.MjData(model), model.nv

    def forward(dq: Array, dv: Array, looped: bool = True) -> tuple[Array, Array]:
        """(acceleration without constraints, passive and actuators' forces) at a nudged state."""
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_integratePos(model, data.qpos, dq, 1.0)
        data.qvel += dv
        seen = (data.qpos, data.qvel) if looped else (qpos, qvel)
        data.ctrl[:] = command if law is None else np.asarray(law(jnp.asarray(command), *map(jnp.array, seen)))
        mujoco.mj_forward(model, data)
        return data.qacc_smooth.copy(), data.qfrc_passive + data.qfrc_actuator

    def columns(wrt: int, looped: bool, what: int) -> Array:
        found = []
        for d in RULES.nudge * np.eye(nv):
            ends = [(s * d, 0 * d) if wrt == 0 else (0 * d, s * d) for s in (1, -1)]
            a, b = (forward(*end, looped)[what] for end in ends)
            found.append((a - b) / (2 * RULES.nudge))
        return np.stack(found, 1)

    position, velocity = columns(0, True, 0), columns(1, True, 0)
    forces = columns(1, False, 1)
    forward(np.zeros(nv), np.zeros(nv))
    inertia = mass_matrix(model, data)
    damped = not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    of_euler = -np.diag(model.dof_damping) if damped else np.zeros((nv, nv))
    implicit = {EULER: np.linalg.solve(inertia, of_euler), IMPLICITFAST: np.linalg.solve(inertia, forces)}
    return _Linear(position, velocity, implicit)
