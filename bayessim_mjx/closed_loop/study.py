"""The work of `bayessim-mjx gap-loop`: simulators from a diagnosis, policies trained once and kept, the results."""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayessim_mjx import atomic, cli, registry
from bayessim_mjx.closed_loop import judge, measures, words
from bayessim_mjx.closed_loop.judge import Judge, Simulators
from bayessim_mjx.closed_loop.policies import Keeper, Policies
from bayessim_mjx.config import Config, freeze
from bayessim_mjx.diagnosis import result
from bayessim_mjx.diagnosis.correction import correction as correction_of
from bayessim_mjx.diagnosis.correction import stepping_of
from bayessim_mjx.diagnosis.fitting import discretisation, robot
from bayessim_mjx.effects.support import storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.read import read_logs
from bayessim_mjx.monitor.writer import TensorBoard
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.runs import versions

SCHEMA = 1
EFFECTS = "effects.yaml"


def loaded(folder: Path) -> result.Diagnosis:
    """Load the diagnosis of a folder; a damaged one is a UserError."""
    try:
        return result.load(folder)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"--diagnosis {folder}: damaged diagnosis.json: {type(error).__name__}: {error}") from None


def correction(diagnosis: result.Diagnosis, folder: Path, known: ParameterSpace) -> storage.Correction:
    """Read the correction of a diagnosis: effects.yaml, or else diagnosis.json on these known parameters.

    Raises:
        UserError: a file is damaged, or nothing was found.
    """
    file = folder / EFFECTS
    found = storage.read(file) if file.is_file() else correction_of(diagnosis, known)
    if not found.effects and not found.calibrated:
        raise UserError(f"--diagnosis {folder}: its verdict is '{diagnosis.verdict}', so there is nothing to correct")
    return found


def nominal_task(config: Config) -> Any:
    """Make the task at its model's own physics."""
    plain = dataclasses.replace(config, randomization=freeze({"randomize": False}))
    return registry.make(config.task, config=plain)


def _on(config: Config, physics: Physics) -> Any:
    """Put the task on other physics; a fresh one, since compiled programs are kept by environment."""
    env = nominal_task(config)
    env.physics = physics
    return env


def _refined(body: robot.Robot, timestep: float | None, flag: str) -> robot.Robot:
    """Give the robot another time step, s; None: it keeps its own."""
    most = float(body.mj_model.opt.timestep)
    if timestep is None:
        return body
    if not 0 < timestep <= most:
        raise UserError(f"{flag} {timestep:g}: must be positive and at most the task's own, {most:g} s")
    return discretisation.refined(body, timestep)


def _integrated(body: robot.Robot, diagnosis: result.Diagnosis) -> robot.Robot:
    """Give the robot the integrator by which a diagnosis simulated."""
    found = stepping_of(diagnosis)
    if found is None:
        return body
    model = copy.copy(body.mj_model)
    model.opt.integrator = found.number
    return dataclasses.replace(body, mj_model=model)


def diagnosed_timestep(diagnosis: result.Diagnosis) -> float | None:
    """s, at which a diagnosis simulated, where the model's own time step errs by more than is tolerated at a joint.

    Policies trained at that step would meet a gap which no effect closes; None: they may have the task's own.
    """
    step, joints = diagnosis.gap.integrator, diagnosis.gap.physical
    errors = step.get("physical", {})
    beyond = [j for j, found in joints.items() if errors.get(j, 0.0) > found.get("tolerance", np.inf)]
    return float(step["substep"]) if beyond else None


def _corrected(body: robot.Robot, dt: float, found: storage.Correction, source: str) -> Physics:
    try:
        return body.physics(dt, found.effects, ParameterSpace(found.calibrated))
    except UserError as error:
        raise UserError(f"{source} does not fit --task {body.name}: {error}") from None


def surrogate(config: Config, file: str | Path, body: robot.Robot | None = None, timestep: float | None = None) -> Any:
    """Put the task on a stand-in for the real system.

    Args:
        file: its truth as an effects.yaml, hidden values as nominal ones.
        body: the task's robot, where it is there already.
        timestep: s, of its simulation (default: the task's own).

    Raises:
        UserError: the file is wrong or does not fit the task.
    """
    body = _refined(body or robot.of_task(nominal_task(config)), timestep, "--surrogate_timestep")
    physics = _corrected(body, float(body.control_dt or 0.0), storage.read(file), f"--surrogate {file}")
    return _on(config, physics)


@dataclass(frozen=True, eq=False)
class Study:
    """All that is fixed, and where results go.

    Attributes:
        given: a policy of the user's in the place of pi_0's training (its checkpoints by step), or None.
        logs: of the real system, where there is no surrogate.
    """

    config: Config
    simulators: Simulators
    judge: Judge
    seeds: int
    out: Path
    sources: dict[str, Any]
    given: Policies | None
    keeper: Keeper
    logs: tuple[Log, ...]

    def opening(self) -> dict[str, Any]:
        """Describe, for a person, what is about to run."""
        s, ppo = self.simulators, self.config.ppo
        steps = ppo.max_iterations * ppo.num_steps * ppo.num_envs
        roles = [r for r in s.roles if not (r == "nominal" and self.given)]
        found = [e.name + "@" + ", ".join(e.places()) for e in s.corrected.physics.effects]
        each = f"{self.seeds} of each, {ppo.max_iterations} PPO iterations = {steps} steps"
        return {
            "task": self.config.task,
            "correction": found + [p.name for p in s.corrected.physics.model_space.parameters],
            "time step": self._steps(),
            "real side": self.sources["real"],
            "policies": f"{', '.join(roles)}; {each}",
            "results": str(self.out),
        }

    def _steps(self) -> str:
        """Of the corrected simulator, where it is not the task's."""
        s = self.simulators
        own, other = (1e3 * float(env.physics.mj_model.opt.timestep) for env in (s.nominal, s.corrected))
        return f"{other:.3g} ms" + ("" if other == own else f" where corrected; the task's own is {own:.3g} ms")

    def all_policies(self, console: Any) -> dict[str, list[Policies]]:
        """By role and seed; the user's own stands for pi_0."""
        out = {}
        for role in self.simulators.roles:
            own = self.given if role == "nominal" else None
            out[role] = [own] if own else [self.keeper.policies(role, seed, console) for seed in range(self.seeds)]
        return out

    def chosen(self, role: str, trainings: list[Policies]) -> list[int]:
        """Of each training the iteration of the policy that is best where it was trained: nothing real decides."""
        score = iter(self.judge.at_home(role, [p for policies in trainings for p in policies.values()]))
        scores = [{mark: next(score) for mark in policies} for policies in trainings]
        return [max(each, key=lambda mark: each[mark]) for each in scores]

    # ---- results

    def run(self, console: Any) -> dict[str, Any]:
        """Run the study and return the contents of gap_loop.json."""
        policies = self.all_policies(console)
        console.say(f"the best policy of each training, {self.judge.episodes} episodes where it was trained ...")
        best = {role: self.chosen(role, each) for role, each in policies.items()}
        console.say("these policies on every simulator ...")
        judged = iter(
            self.judge.everywhere([p[at] for r, each in policies.items() for p, at in zip(each, best[r], strict=True)])
        )
        rows = {role: [next(judged) for _ in each] for role, each in policies.items()}
        out: dict[str, Any] = {"schema": SCHEMA, "task": self.config.task, **self.sources}
        out["settings"] = {"seeds": self.seeds, "episodes": self.judge.episodes, "ppo": self.config.ppo.to_dict()}
        out["policies"] = {role: _table(best[role], each) for role, each in rows.items()}
        out["gap"] = out["ranking"] = out["recovery"] = out["replay"] = None
        if self.simulators.real is not None:
            console.say("and those that were kept on the way, for the ranking ...")
            every = self.judge.everywhere([p for each in policies["nominal"] for p in each.values()])
            out["gap"] = {"policy": measures.gap(rows["nominal"]), "training": measures.gap(every)}
            out["ranking"] = measures.ranking(every)
            real = {role: np.stack([r["real"] for r in each]) for role, each in rows.items()}
            out["recovery"] = measures.recovery(real)
        else:
            out["replay"] = judge.replay(self.logs, self.simulators.nominal.physics, self.simulators.corrected.physics)
        console.say("what each effect changes ...")
        out["effects"] = self._relevance(policies, best, rows)
        out["sentences"] = words.sentences(out)
        out["versions"] = versions()
        return out

    def _relevance(self, policies: dict, best: dict, rows: dict) -> list[dict[str, Any]]:
        """Measure what each effect changes, for the first policy before and after retraining."""
        first = {role: policies[role][0][best[role][0]] for role in ("nominal", "corrected")}
        cost = float(np.mean(rows["nominal"][0]["nominal"] - rows["nominal"][0]["corrected"]))
        before, after = self.judge.one_by_one([first["nominal"], first["corrected"]])
        return measures.relevance(before, after, cost)

    def write(self, found: dict[str, Any]) -> Path:
        """gap_loop.json and the scalars; returns the former's path."""
        path = self.out / "gap_loop.json"
        atomic.write_text(path, json.dumps(found, indent=1, allow_nan=False) + "\n")
        with TensorBoard(self.out, purge_step=0) as writer:
            writer.scalars(0, _scalars(found))
            writer.text("closed_loop", "\n\n".join(found["sentences"]))
        return path


def _table(best: list[int], rows: list[dict[str, np.ndarray]]) -> list[dict[str, Any]]:
    """Per seed: the iteration chosen, and mean and standard error of its return on every simulator."""
    moments = [
        {s: {"mean": float(x.mean()), "se": measures.standard_error(x)} for s, x in returns.items()} for returns in rows
    ]
    return [{"seed": i, "iteration": at, "returns": m} for i, (at, m) in enumerate(zip(best, moments, strict=True))]


def _scalars(found: dict[str, Any]) -> dict[str, Any]:
    """Tags of TensorBoard."""
    out: dict[str, Any] = {}
    for role, each in found["policies"].items():
        for simulator in each[0]["returns"]:
            out[f"Return_{simulator}/{role}"] = float(np.mean([p["returns"][simulator]["mean"] for p in each]))
    if found["gap"]:
        out |= {f"Gap/{k}": found["gap"]["policy"][k] for k in ("before", "after", "closure")}
        out |= {f"Ranking/tau_{s}": v for s, v in found["ranking"]["tau"].items()}
        out |= {f"Recovered/{role}": found["recovery"][role]["recovered"] for role in ("corrected", "wide")}
    return out


def make(args: argparse.Namespace, config: Config) -> Study:
    """Everything that can be wrong with the input is refused here.

    Raises:
        UserError: the diagnosis, the surrogate or the logs do not fit the task.
    """
    folder = Path(args.diagnosis)
    body = robot.of_task(nominal_task(config), args.parameters)
    dt = float(body.control_dt or 0.0)
    diagnosis = loaded(folder)
    step = args.timestep
    if step is None and (found := diagnosed_timestep(diagnosis)) is not None:
        step = min(found, float(body.mj_model.opt.timestep))
    finer = _integrated(_refined(body, step, "--timestep"), diagnosis)
    physics = _corrected(finer, dt, correction(diagnosis, folder, body.space), f"--diagnosis {folder}")
    nominal = _on(config, body.physics(dt, (), judge.wide(body.space)))
    real = logs = None
    if args.surrogate:
        real = surrogate(config, args.surrogate, body, args.surrogate_timestep)
    else:
        logs = read_logs(args.real, body.mj_model)
    simulators = Simulators(nominal, _on(config, physics), real)
    out = Path(args.out or folder / "gap_loop")
    given = _given(args, config, nominal)
    out.mkdir(parents=True, exist_ok=True)
    return Study(
        config=config,
        simulators=simulators,
        judge=Judge(simulators, args.episodes, jax.random.PRNGKey(config.seed + 10_000)),
        seeds=args.seeds,
        out=out,
        sources={"diagnosis": str(folder), "real": args.surrogate or [log.name for log in logs or ()]},
        given=given,
        keeper=Keeper(config, simulators, out / "policies"),
        logs=tuple(logs or ()),
    )


def _given(args: argparse.Namespace, config: Config, env: Any) -> Policies | None:
    """Load the policies of --checkpoint: all checkpoints of a run, or the one."""
    if not args.checkpoint:
        return None
    path, run = cli.find_checkpoint(args.checkpoint, config.task, "logs")
    if run is None:
        return {0: cli.load_policy(path, env, config)}
    return {c["step"]: cli.load_policy(run.path / c["path"], env, config) for c in run.checkpoints}
