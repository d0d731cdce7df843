"""Black boxes as rivals of the named effects: a small network and a sparse formula for the force that is missing.

Both know only positions, speeds and efforts of the joints, and are fitted through the simulator's own columns (as the
flexible force is) to what the recalibrated simulator leaves, together with its known parameters. All three are scored
on the same conditions, which none of them saw. Their inputs are measured motion, so that they are favoured: in a
simulation they would have to live with the motion that they cause.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.gap import Gap
from bayessim_mjx.diagnosis.residual import formula, motion_inputs, network
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.formula import Term
from bayessim_mjx.diagnosis.residual.regression import Regression

Array = NDArray[np.float64]
FOLDS = 4  # of conditions, at most: each is one more training of the network


@dataclass(frozen=True, eq=False)
class BlackBoxes:
    """Shares of the recalibrated simulator's squared gap above the noise that are closed, on conditions held out.

    Attributes:
        network, formula: of the black boxes; named: of the effects of the verdict, NaN of none. Below 0: worse than
            nothing.
        terms: of the formula that is fitted to all conditions, for people.
        folds: into which the conditions were divided.
    """

    network: float
    formula: float
    named: float
    terms: tuple[Term, ...]
    folds: int


def race(fitter: Fitter, base: Fit, named: Fit | None, missing: Disturbance, noise: float) -> BlackBoxes | None:
    """All of them on the same windows; None where there is one condition only.

    Args:
        base: the fit of the known parameters; named: with the effects, None without any.
        missing: of the base fit, for its columns; noise: squared residual of a window that is noise alone.
    """
    windows = fitter.simulator.windows
    fold = np.unique(windows.group, return_inverse=True)[1] % FOLDS
    if len(np.unique(fold)) < 2:
        return None
    problem = Regression(fitter, base, missing, motion_inputs.measured(windows, fitter.simulator.physics.mj_model))
    before, floor = float(problem.base(fold).sum()), noise * len(fold)

    def closed(cost: Array) -> float:
        return Gap(before, float(cost.sum()), floor).closed

    of_formula, terms = formula.held_out(problem, fold)
    of_names = float("nan") if named is None else closed(fitter.scores(named, fold)[0])
    return BlackBoxes(
        closed(network.held_out(problem, fold)), closed(of_formula), of_names, terms, len(np.unique(fold))
    )
