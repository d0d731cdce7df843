"""What an effect says of each of its numbers."""

import dataclasses
import math

# (stream of a log that shows an effect directly, what to record)
BUS = ("voltage", "bus voltage and motor current (`voltage`, `current:<actuator>`)")
EFFORT = ("effort", "the drive's measured effort (`effort:<actuator>`)")
EFFORT_OR_CURRENT = ("effort", "the drive's measured effort or current (`effort:<actuator>`)")
LINK_ENCODER = ("link", "an encoder on the link side of the gearbox (`link:<joint>`)")
SET_POINT = ("effort", "the drive's own set-point, or its measured effort (`effort:<actuator>`)")

STATED = 8.0  # standard deviations of what a data sheet states, in the width of its range


@dataclasses.dataclass(frozen=True)
class Quantity:
    """One number of an effect at one place.

    Attributes:
        name: of the parameter.
        neutral: the value that switches it off (its part of the effect) exactly.
        low, high: range where nothing is known of the robot.
        unit: for a hinge; a slide's is derived from it.
        per: what the range grows with, so that one library fits a toy servo and an industrial arm: "force" (largest
            effort or load at the place), "command" (largest command), "speed", "travel", "inertia" (M_ii), "period" (of
            the logs); of bodies "mass", "weight", "size", "carried" (mass that the robot can hold there), "tool" (how
            far a load may reach); or products such as "force/speed"; "" for absolute ranges.
        reach: (low, high) in multiples of `per`, used by the diagnosis in the place of low, high.
        grid: starting values for a fit, as fractions of the way from neutral to each end of the range.
        prior: "uniform" or "loguniform".
        shape: it only shapes the effect (a speed, an order, a lever arm): where the other quantities are neutral the
            effect is off whatever this one is; `grid` is then in fractions of the range from low to high.
        at_least: ends of the range that `reach` gives are raised to `low` and `high` where they are below.
        most: end that physics sets, whatever the range is (friction that outgrows its load).
        stated: a data sheet states it: its prior is Gaussian, and STATED of its standard deviations make the range.
        remembered: the range sizes the effect's memory, so that no fit can go beyond it.
        optional: it is an entry of theta only where the effect's `parameters` name it (a range was given, or a
            diagnosis tries it); elsewhere it is neutral.
        half: the whole that it is half of, which people state: "play"; "" where it is no half.
    """

    name: str
    neutral: float
    low: float
    high: float
    unit: str = ""
    per: str = ""
    reach: tuple[float, float] | None = None
    grid: tuple[float, ...] = (0.03, 0.15, 0.5)
    prior: str = "uniform"
    shape: bool = False
    at_least: bool = False
    most: float = math.inf
    stated: bool = False
    remembered: bool = False
    optional: bool = False
    half: str = ""

    @property
    def deviation(self) -> float:
        """Standard deviation of what is `stated`, in multiples of `per`."""
        low, high = self.reach or (self.low, self.high)
        return (high - low) / STATED

    def ends(self) -> tuple[float, float]:
        """Where physics ends: at neutral, where the range does; at 0 for what is positive; at `most`."""
        least = self.low if self.low == self.neutral else 0.0 if self.low > 0 else -math.inf
        return least, self.high if self.high == self.neutral else self.most


def delay(high: float, grid: tuple[float, ...]) -> Quantity:
    """Declare a time lag, s; up to three periods of the logs, and at least up to `high`."""
    periods = (0.0, 3.0)
    return Quantity(
        "delay", 0.0, 0.0, high, unit="s", per="period", reach=periods, grid=grid, at_least=True, remembered=True
    )
