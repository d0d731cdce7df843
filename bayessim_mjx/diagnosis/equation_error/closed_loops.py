"""Gains of servos and controllers, checked against the model itself: a fast loop moves between the rows of a log.

Rows and filters then show efforts that nothing exerted, and a gain explains them best. The model on the same commands,
sampled as the log is, shows the same ones: by as much as that is a gain wrong without any cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import mujoco
import numpy as np

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error.fit import Term
from bayessim_mjx.diagnosis.equation_error.search import Found
from bayessim_mjx.diagnosis.equation_error.sums import Sums, gather
from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.diagnosis.logcheck.effort import HALF
from bayessim_mjx.effects.support.actuators import OfGains, OfLoops
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import controllers


class OfModel:
    """Sums of the model's own logs of the same commands, made when they are first needed."""

    def __init__(self, logs: Sequence[Log], model: mujoco.MjModel) -> None:
        self.logs, self.model = logs, model

    @cached_property
    def sums(self) -> Sums:
        return gather([of_model(log, self.model) for log in self.logs], self.model)

    def artefacts(self, known: Sequence[Term], found: Found) -> set[str]:
        """Return labels of the proposed gains of which the model's own logs show a half or more."""
        gains = [p.term for p in found.proposals if of_loop(p.term)]
        there = fitting.fit(self.sums, [*known, *(p.term for p in found.proposals)]) if gains else found.fit
        return {t.label for t in gains if abs(there.of(t)[0]) > HALF * abs(found.fit.of(t)[0])}


def of_loop(term: Term) -> bool:
    """Whether a term is a gain of a servo or a declared controller."""
    return term.bent is not None and issubclass(library.load(term.effect), OfGains | OfLoops)


def of_model(log: Log, model: mujoco.MjModel) -> Log:
    """Return the log that the model makes of the same commands, without noise, from the same start."""
    data = mujoco.MjData(model)
    law = drives.DeclaredLaw(controllers.read(log.metadata, model, log.actuators, log.name))
    data.qpos[:], data.qvel[:] = log.qpos[0], log.qvel[0]
    step, rows = float(model.opt.timestep), []
    for k, time in enumerate(log.time):
        while k and data.time < time - log.time[0] - step / 2:
            data.ctrl[:] = law(log.ctrl[k - 1], data.qpos, data.qvel)
            mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel]))
    qpos, qvel = np.split(np.nan_to_num(np.array(rows)), [model.nq], axis=1)
    # a measured effort did not make this motion
    streams = {name: own for name, own in log.streams.items() if not name.startswith("effort:")}
    return replace(log, qpos=qpos, qvel=qvel, streams=streams)
