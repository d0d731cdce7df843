"""What reality does and the nominal model does not, in MuJoCo C: the contract of a cause.

Nothing in these files is taken from the library's effects: dry friction is a LuGre bristle with an ODE of its own, play
and elasticity are a second joint behind the rotor, springs, drag, lag and limits are MuJoCo's attributes.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

if TYPE_CHECKING:
    from truth import Plant


@dataclasses.dataclass(frozen=True)
class Scales:
    """What the robot does without causes: largest force, speed, ... by joint, mass by body, command by actuator."""

    force: dict[str, float]
    speed: dict[str, float]
    travel: dict[str, tuple[float, float]]
    inertia: dict[str, float]
    command: dict[str, float]
    rate: dict[str, float]
    mass: dict[str, float]
    drives: dict[str, str]  # actuator -> joint
    timestep: float
    servo: bool


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

    def reset(self, plant: "Plant", command: np.ndarray) -> None:
        """Clear the memory at the start of a run, `command` being the first one."""

    def command(self, plant: "Plant", u: np.ndarray) -> None:
        """Change the command `[nu]` of this sub-step in place."""

    def force(self, plant: "Plant") -> None:
        """Add forces of this sub-step to `plant.data`."""

    def watch(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        """See the true joint positions and velocities at the end of a sub-step."""

    def sense(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        """Change the measured positions and velocities of a row in place."""

    def parameters(self) -> dict[str, float]:
        """Physical values, under the library's names where the meaning is the same."""
        return {"size": self.size}
