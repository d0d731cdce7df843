"""Policies of a closed-loop study: each is trained once; a study that was interrupted takes up those that are there."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayessim_mjx import rl
from bayessim_mjx.closed_loop import judge
from bayessim_mjx.closed_loop.judge import Simulators
from bayessim_mjx.config import Config
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.clock import CompileClock
from bayessim_mjx.monitor.writer import TensorBoard
from bayessim_mjx.rl import Policy
from bayessim_mjx.runs import checkpoints

SHOWN = ("Train/mean_reward", "Perf/total_fps")
Policies = dict[int, Policy]  # by PPO iteration


@dataclass(frozen=True, eq=False)
class Keeper:
    """Trains policies, or finds them in `folder`/<role>_<seed>/<iteration>, with their curves beside them."""

    config: Config
    simulators: Simulators
    folder: Path
    clock: CompileClock = field(default_factory=CompileClock)

    def policies(self, role: str, seed: int, console: Any) -> Policies:
        """Those of one training, by iteration; trained now where they are not there or come from other settings."""
        folder, fingerprint = self.folder / f"{role}_{seed}", self.fingerprint(role, seed)
        kept = self._kept(folder, fingerprint)
        if kept is not None:
            console.say(f"{role} {seed}: trained before, in {folder}")
            return kept
        shutil.rmtree(folder, ignore_errors=True)
        return self._trained(folder, role, seed, fingerprint, console)

    def fingerprint(self, role: str, seed: int) -> str:
        """Hash everything that the training depends on."""
        env, domain = self.simulators.training(role)
        physics = env.physics
        fixed = [self.config.task, self.config.ppo.to_dict(), self.config.env.to_dict(), self.config.seed + seed]
        # what is not drawn matters by its value alone
        theta = repr(physics.space.parameters) if domain is not None else physics.space.nominal.tolist()
        where = [(e.name, e.where) for e in physics.effects]
        step = float(physics.mj_model.opt.timestep)
        return hashlib.sha256(repr([fixed, theta, where, step]).encode()).hexdigest()[:16]

    def _kept(self, folder: Path, fingerprint: str) -> Policies | None:
        ppo, env = self.config.ppo, self.simulators.nominal
        shape = jax.eval_shape(lambda key: rl.policy_of(rl.init(env, ppo, key)), jax.random.PRNGKey(0))
        out = {}
        for mark in judge.marks(ppo.max_iterations):
            try:
                tree, meta = checkpoints.restore(folder / f"{mark:06d}", {"policy": shape})
            except UserError:  # not there, or cut short
                return None
            if meta.get("fingerprint") != fingerprint:
                return None
            out[mark] = tree["policy"]
        return out

    def _trained(self, folder: Path, role: str, seed: int, fingerprint: str, console: Any) -> Policies:
        out: Policies = {}
        ppo, (env, domain) = self.config.ppo, self.simulators.training(role)
        console.phase(f"{role} {seed}", ppo.max_iterations)
        with TensorBoard(folder) as writer:

            def progress(metrics: dict[str, Any], state: Any) -> None:
                writer.scalars(int(state.iteration), {k: v for k, v in metrics.items() if "/" in k})
                self.clock.report(console, "the training")
                console.iteration({k: metrics[k] for k in SHOWN}, int(state.iteration))

            def keep(mark: int, policy: Policy) -> None:
                checkpoints.save(folder / f"{mark:06d}", {"policy": policy}, mark, {"fingerprint": fingerprint})
                out[mark] = jax.tree.map(np.asarray, policy)

            # the same key for every role: policies of one seed begin with the same network
            key = jax.random.PRNGKey(self.config.seed + seed)
            judge.train(env, ppo, key, domain, judge.marks(ppo.max_iterations), keep, progress)
        return out
