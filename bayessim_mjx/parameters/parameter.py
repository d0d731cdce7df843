"""One named physical number: range, prior, and which attribute of which MuJoCo element it stands for."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import checks

PRIORS = ("uniform", "loguniform", "gaussian")
OPERATIONS = ("scaling", "additive", "absolute")
COURSES = ("constant", "linear")
OVER = 2**30  # control steps after which all schedules are over; also where no training counts them


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How strongly something is randomised as training goes on (BayesSimIG's `schedule` and `schedule_steps`).

    `linear`: from nothing at step 0 to all at `steps`; `constant`: nothing before `steps`, then all at once.

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


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A physical number that may be randomised or inferred.

    Attributes:
        name: unique in its space, e.g. `pole_mass_mult`, `cart_to_pole_damping`.
        nominal: the value at which the model is as its MJCF says (or closest to it inside the range).
        low, high: the range; every prior lives on it.
        unit: of theta, for people; "" for multipliers.
        prior: "uniform" | "loguniform" | "gaussian" (mean and sd in theta units, truncated to the range).
        operation: on the model's own number x: "scaling" x theta, "additive" x + theta, "absolute" theta.
        attribute: "mass", "friction", ... (see `attributes.py` for what each writes).
        target: name of the MuJoCo element; "#<id>" for an unnamed one.
        kind: "body" | "geom" | "joint" | "actuator" | "tendon" | "option" | "actor" | "effect".
        factor: MuJoCo units per unit of theta, for additive and absolute parameters.
        axis: unit vector in the body frame along which "length" stretches; None: the long axis of the (concrete) model.
        schedule: how far from nominal training draws it as it goes on; inference and evaluation see the whole prior.

    Raises:
        UserError: empty range, nominal outside it, a prior that does not fit the range, unknown words.
    """

    name: str
    nominal: float
    low: float
    high: float
    unit: str = ""
    prior: str = "uniform"
    mean: float | None = None
    sd: float | None = None
    operation: str = "scaling"
    attribute: str = ""
    target: str = ""
    kind: str = "effect"
    factor: float = 1.0
    axis: tuple[float, float, float] | None = None
    schedule: Schedule = Schedule()

    def __post_init__(self) -> None:
        where = f"parameter {self.name!r}"
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise UserError(f"{where}: range [{self.low}, {self.high}] must be finite with low < high")
        if not self.low <= self.nominal <= self.high:
            raise UserError(f"{where}: nominal {self.nominal} is outside its range [{self.low}, {self.high}]")
        if self.prior not in PRIORS:
            raise UserError(f"{where}: prior {self.prior!r} is none of {', '.join(PRIORS)}")
        if self.operation not in OPERATIONS:
            raise UserError(f"{where}: operation {self.operation!r} is none of {', '.join(OPERATIONS)}")
        if self.prior == "loguniform" and self.low <= 0:
            raise UserError(f"{where}: a loguniform prior needs low > 0, not {self.low}")
        if self.prior == "gaussian" and (self.mean is None or self.sd is None or not self.sd > 0):
            raise UserError(f"{where}: a gaussian prior needs mean and sd > 0, not mean={self.mean}, sd={self.sd}")
        if self.factor == 0 or not math.isfinite(self.factor):
            raise UserError(f"{where}: factor {self.factor} must be finite and not 0")
        _check_operation(self)


def _check_operation(p: Parameter) -> None:
    if p.kind == "effect":
        return
    if p.operation != "scaling" and p.attribute in ("inertia", "length", "scale"):
        raise UserError(f"parameter {p.name!r}: {p.attribute} knows only the operation 'scaling', not {p.operation!r}")
    if p.operation == "scaling" and p.attribute in ("length", "scale", "mass", "inertia") and p.low <= 0:
        raise UserError(f"parameter {p.name!r}: {p.attribute} is scaled by theta > 0, so low must be > 0, not {p.low}")
