"""How strongly something is randomised as training goes on (BayesSimIG's `schedule` and `schedule_steps`)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import checks

COURSES = ("constant", "linear")
OVER = 2**30  # control steps after which all schedules are over; also where no training counts them


@dataclasses.dataclass(frozen=True)
class Schedule:
    """`linear`: from nothing at step 0 to all at `steps`; `constant`: nothing before `steps`, then all at once.

    Steps are control steps of each world since training began.
    """

    course: str = "constant"
    steps: int = 0

    @classmethod
    def read(cls, setting: Mapping[str, Any], where: str) -> "Schedule":
        """Of the keys `schedule` and `schedule_steps` of a setting.

        Raises:
            UserError: naming the key, its value and what is allowed.
        """
        course = (
            checks.choice(setting, "schedule", COURSES, "constant", where) if setting.get("schedule") else "constant"
        )
        steps = checks.number(setting.get("schedule_steps") or 0, f"{where}.schedule_steps")
        if not (0 <= steps < OVER and steps == int(steps)):
            raise UserError(
                f"{where}.schedule_steps = {setting['schedule_steps']!r}: expected a whole number of control steps "
                f"from 0 to {OVER - 1}"
            )
        if course == "linear" and not steps:
            raise UserError(f"{where}.schedule_steps: a linear schedule needs the number of steps that it takes")
        return cls(course, int(steps))

    def strength(self, clock: jax.Array) -> jax.Array:
        """Compute the share [0, 1] of the randomisation at `clock` control steps."""
        if not self.steps:
            return jnp.ones_like(clock, jnp.float32)
        if self.course == "linear":
            return jnp.minimum(jnp.asarray(clock, jnp.float32) / self.steps, 1.0)
        return (clock >= self.steps).astype(jnp.float32)
