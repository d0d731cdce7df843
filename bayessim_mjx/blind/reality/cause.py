"""What reality does and the nominal model does not, in MuJoCo C: the contract of a cause.

Nothing in these files is taken from the library's effects: dry friction is a LuGre bristle with an ODE of its own, play
and elasticity are a second joint behind the rotor, springs, drag, lag and limits are MuJoCo's attributes.
"""

import dataclasses
from typing import ClassVar, Protocol

import mujoco
import numpy as np


class Simulated(Protocol):
    """What a cause sees of the robot that it acts on (`plant.Plant`)."""

    model: mujoco.MjModel
    data: mujoco.MjData
    timestep: float

    def column(self, joint: str) -> int:
        """Of a joint in measured positions."""

    def speed_column(self, joint: str) -> int:
        """Of a joint in measured velocities."""

    def address(self, joint: str) -> int:
        """Of a joint in `data.qpos`."""

    def dof(self, joint: str) -> int:
        """Of a joint in `data.qvel`."""

    def position(self, joint: str) -> float:
        """Give the true position of a joint, before any play behind it."""


@dataclasses.dataclass(frozen=True)
class Past:
    """A run up to a row: time [T] s since it began, positions q and velocities v [T, n], commands u [T, nu]."""

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    u: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scales:
    """What the robot does without causes: largest force, speed, ... by joint, mass by body, command by actuator.

    Attributes:
        effort: largest force over the gear, by actuator; drives: {actuator: its joint}.
        servo: actuators that take positions; base: the body that stands on the ground, "" where the robot has none.
        ends: bodies at the ends of chains and those before them; rotors: driven joints that are alone in their body;
        direct: actuators without a filter of their own; led: those that follow positions or velocities.
        length: m, of the rod that turns as hard, by body that turns; axis: of its own hinge, [3] in its frame, zeros of
            a body that has another number of them. ground: whether there is any that can be touched.
        floats: bodies that have a free joint.
        chain: (joint before, first joint behind) of each joint, "" where there is none.
    """

    force: dict[str, float]
    speed: dict[str, float]
    travel: dict[str, tuple[float, float]]
    inertia: dict[str, float]
    command: dict[str, float]
    rate: dict[str, float]
    mass: dict[str, float]
    drives: dict[str, str]
    timestep: float
    servo: frozenset[str]
    effort: dict[str, float]
    base: str
    ends: tuple[str, ...]
    rotors: tuple[str, ...]
    direct: frozenset[str]
    led: frozenset[str]
    length: dict[str, float]
    axis: dict[str, np.ndarray]
    ground: bool
    floats: tuple[str, ...]
    chain: dict[str, tuple[str, str]]


class Cause:
    """One thing that is different in reality at one place; `size` 0 is absent and grows up to `largest`.

    Subclasses set `largest` (and `smallest`, what the time step can resolve) and what else they draw in `draw`.
    """

    name: ClassVar[str]
    kind: ClassVar[str] = "joint"
    stepped: ClassVar[bool] = False  # acts in Python in every sub-step
    smallest: float = 0.0
    largest: float = 1.0

    def __init__(self, where: str, scales: Scales, rng: np.random.Generator, size: float = 0.0) -> None:
        self.where, self.scales, self.size = where, scales, size
        self.draw(rng)

    def draw(self, rng: np.random.Generator) -> None:
        """Choose everything but the size; set `largest`."""

    def edit(self, spec: mujoco.MjSpec) -> None:
        """Write natively into the model."""

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        """Clear the memory at the start of a run, `command` being the first one."""

    def resume(self, plant: Simulated, past: Past) -> None:
        """Remember the motion before, after `reset` at a row of a run that is not its first."""

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        """Change the command `[nu]` of this sub-step in place."""

    def force(self, plant: Simulated) -> None:
        """Add forces of this sub-step to `plant.data`."""

    def watch(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        """See positions and velocities at the end of a sub-step, as the causes before this one show them."""

    def sense(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        """Change the measured positions and velocities of a row in place."""

    def parameters(self) -> dict[str, float]:
        """Physical values, under the library's names where the meaning is the same."""
        return {"size": self.size}
