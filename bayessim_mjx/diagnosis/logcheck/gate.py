"""The data gate of the diagnosis: which logs can be used, which not and why, and what is odd about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck import effort, single_log
from bayessim_mjx.diagnosis.logcheck.drives import dof_of, efforts, is_effort, looped
from bayessim_mjx.diagnosis.logcheck.effort import Relation
from bayessim_mjx.diagnosis.logcheck.single_log import Finding
from bayessim_mjx.diagnosis.logcheck.timing import Late, Timing
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.exchanged import SWAPPED, Exchange, exchanges
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import Velocity, agreeing, velocities
from bayessim_mjx.quantities import MOST, listed


@dataclass(frozen=True, eq=False)
class Report:
    """What the gate says about one log.

    Attributes:
        relations: effort against motion, per joint and source.
        velocities: measured velocities against derivatives of positions.
    """

    log: Log
    remarks: tuple[Finding, ...]
    relations: tuple[Relation, ...] = ()
    velocities: tuple[Velocity, ...] = ()

    @property
    def usable(self) -> bool:
        return not self.of("refused")

    @property
    def first(self) -> list[Relation]:
        """One relation of each joint that was tested: a stream of efforts comes before the command."""
        return [*{r.joint: r for r in reversed(self.relations) if r.explained is not None}.values()]

    def unexplained(self, drives: int) -> bool:
        """Whether neither motion nor exchanged columns explain the efforts of so many drives; False of broken logs."""
        sound = [(r.explained or 0.0) >= effort.SOUND for r in self.first]
        known = any(SWAPPED in r.mend for r in self.relations) or len(sound) == drives and all(sound)
        return (self.usable or bool(self.relations)) and not known

    def saying(self, text: str) -> Report:
        """With one more remark, which warns of a usable log and says why another one is refused."""
        return replace(self, remarks=(*self.remarks, Finding("warning" if self.usable else "refused", text)))

    def of(self, kind: str) -> tuple[str, ...]:
        """Return the texts of one kind: refused, warning or finding."""
        return tuple(r.text for r in self.remarks if r.kind == kind)


@dataclass(frozen=True, eq=False)
class Gate:
    """The reports of all logs, in their order.

    Attributes:
        qvel: per measured velocity channel, whether it agrees with its position in most of the usable logs.
        timing: of the usable logs.
        exchanged: commands that fit the motion of other joints, in logs whose efforts nothing better explains.
    """

    reports: tuple[Report, ...]
    qvel: dict[str, bool]
    timing: Timing
    exchanged: tuple[Exchange, ...] = ()

    @property
    def usable(self) -> tuple[Log, ...]:
        return tuple(r.log for r in self.reports if r.usable)

    @property
    def refused(self) -> dict[str, str]:
        """Reasons by the name of the log."""
        return {r.log.name: "; ".join(r.of("refused")) for r in self.reports if not r.usable}

    @property
    def reasons(self) -> dict[str, list[str]]:
        """Names of the refused logs by the reason."""
        out: dict[str, list[str]] = {}
        for name, reason in self.refused.items():
            out.setdefault(reason, []).append(name)
        return out

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence each, beginning with the names of the logs."""
        refused = (f"{listed(names, most=MOST)}: refused: {reason}" for reason, names in self.reasons.items())
        return (*refused, *self.doubts)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings on usable logs."""
        return self._all("warning") + self._not_compared()

    @property
    def findings(self) -> tuple[str, ...]:
        """What is odd, but a property of the robot rather than of the log (delays)."""
        return self._all("finding")

    @property
    def use_qvel(self) -> bool:
        """Whether the measured velocities may be compared with the simulator's; otherwise the positions say it all."""
        alone = any((log.seen_speeds & ~log.seen_dofs).any() for log in self.usable)  # with no position beside it
        return (alone or bool(self.qvel)) and all(self.qvel.values()) and all(log.has_qvel for log in self.usable)

    def demand(self) -> tuple[Log, ...]:
        """Return the usable logs.

        Raises:
            UserError: there is none; with every reason.
        """
        if not self.usable:
            each = (f"{listed(names, most=MOST)}: {reason}" for reason, names in self.reasons.items())
            reasons = "; ".join(each) or "no logs were given"
            raise UserError(f"no usable log: {reasons}")
        return self.usable

    def of_logs(self, logs: Sequence[Log]) -> Gate:
        """With others in the place of the usable logs."""
        if all(a is b for a, b in zip(self.usable, logs, strict=True)):
            return self
        own = iter(logs)
        return replace(self, reports=tuple(replace(r, log=next(own)) if r.usable else r for r in self.reports))

    def moved(self, late: float) -> Gate:
        """With logs whose commands act `late` s later than they did."""
        reports = tuple(replace(r, log=r.log.shifted(late)) for r in self.reports) if late else self.reports
        return replace(self, reports=reports, timing=replace(self.timing, moved=self.timing.moved + late))

    def _not_compared(self) -> tuple[str, ...]:
        """One sentence per reason: many logs of many joints would bury everything else."""
        reasons: dict[tuple[str, str], tuple[dict[str, None], dict[str, None]]] = {}  # the names each once, in order
        for report in self.reports:
            for r in report.relations:
                if report.usable and r.text:
                    logs, joints = reasons.setdefault((r.source, r.text), ({}, {}))
                    logs[report.log.name] = joints[r.joint] = None
        return tuple(
            f"{listed([*logs], most=MOST)}: effort of {listed([*joints], most=MOST)} ({why[0]}) not compared with the "
            f"motion: {why[1]}"
            for why, (logs, joints) in reasons.items()
        )

    def _all(self, kind: str) -> tuple[str, ...]:
        """One sentence for all logs of which the same is said; delays from the shortest to the longest."""
        each: dict[str, list[tuple[str, float]]] = {}
        for name, remark in ((r.log.name, x) for r in self.reports if r.usable for x in r.remarks if x.kind == kind):
            each.setdefault(remark.text, []).append((name, remark.delay))
        out = []
        for text, own in each.items():
            ends = [f"{1e3 * delay:.0f}" for delay in (min(s for _, s in own), max(s for _, s in own))]
            late = f" {' to '.join(dict.fromkeys(ends))} ms late" if any(s for _, s in own) else ""
            out.append(f"{listed([name for name, _ in own], most=MOST)}: {text}{late}")
        return tuple(out)


def check(logs: Sequence[Log], mj_model: mujoco.MjModel, dt: float) -> Gate:
    """Judge every log against the model and the control period dt [s]. No fault of the motion raises: read the verdict.

    Raises:
        UserError: dt is no time, or a log declares a controller that cannot be read.
    """
    if not (np.isfinite(dt) and dt > 0):
        raise UserError(f"gate: dt = {dt!r}; allowed: seconds > 0")
    reports = tuple(_report(log, mj_model, dt, len(logs)) for log in logs)
    crossed = exchanges([r.log for r in reports if r.unexplained(mj_model.nu)], mj_model)
    said = {id(log): x.sentence for x in crossed for log in x.logs}
    reports = tuple(r.saying(said[id(r.log)]) if id(r.log) in said else r for r in reports)
    usable = [r for r in reports if r.usable]
    seen = [v for r in usable for v in r.velocities]
    first = [(e.joint, e.late) for r in usable for e in r.first]
    timing = Timing(pooled((v.channel, Late(v.lag)) for v in seen), pooled(first))
    return Gate(reports, agreeing(seen, max([dt, *(r.log.period for r in usable)])), timing, crossed)


def _report(log: Log, mj_model: mujoco.MjModel, dt: float, logs: int) -> Report:
    own = single_log.alone(log, dt, logs)
    if any(f.kind == "refused" for f in own):
        return Report(log, own)  # nothing further can be computed from it
    found = () if log.lost else tuple(efforts(log, mj_model))  # forces on a joint need the motion of all
    related = tuple(effort.relations(log, mj_model, found))
    unrelated = effort.remarks(related)
    seen = tuple(velocities(log))
    behind = [Finding("warning", v.sentence()) for v in seen if not v.usable(max(dt, log.period))]
    targets = _targets(log, mj_model)
    vouched = _vouched(log, mj_model, related, targets)
    own += (*single_log.clipped(log, targets), *single_log.units(log, vouched))
    return Report(log, (*own, *behind, *unrelated), related, seen)


def _targets(log: Log, mj_model: mujoco.MjModel) -> dict[str, Array]:
    """{joint: `[T]`} targets of the joints whose only drive follows one."""
    out: dict[str, Array] = {}
    dofs = [dof_of(mj_model, i) for i in range(mj_model.nu)]
    for i, dof in enumerate(dofs):
        if dof is not None and dofs.count(dof) == 1 and (looped(log) or not is_effort(mj_model, i)):
            out[log.joints[int(mj_model.dof_jntid[dof])]] = log.ctrl[:, i]
    return out


def _vouched(log: Log, mj_model: mujoco.MjModel, related: Sequence[Relation], targets: Mapping[str, Array]) -> set[str]:
    """Joints whose positions have the model's unit: its dynamics, its range or its drives' targets say so."""
    found = {r.joint for r in related if r.source == "ctrl" and (r.explained or 0.0) >= effort.SOUND}
    for j, joint in enumerate(log.joints):
        q = log.qpos[:, log.channels.columns(joint).start]
        low, high = mj_model.jnt_range[j]
        room = 0.1 * (high - low)
        if mj_model.jnt_limited[j] and low - room <= q.min() and q.max() <= high + room:
            found.add(joint)
        moved = np.ptp(targets[joint]) if joint in targets else 0.0
        # halfway, on a logarithmic scale, to degrees, the unit that is nearest to the model's
        if moved > 0 and np.ptp(q) > 0 and abs(np.log(np.ptp(q) / moved)) < 0.5 * np.log(np.degrees(1.0)):
            found.add(joint)
    return found


def pooled(each: Iterable[tuple[str, Late]]) -> dict[str, Late]:
    """{name: median over logs}; its error is the median of those that are known over the root of their number."""
    of: dict[str, list[Late]] = {}
    for name, late in each:
        of.setdefault(name, []).append(late)
    out = {}
    for name, own in of.items():
        known = [x.error for x in own if np.isfinite(x.error)]
        error = float(np.median(known)) / len(known) ** 0.5 if known else float("nan")
        out[name] = Late(float(np.median([x.seconds for x in own])), error)
    return out
