"""What a person sees of a run of the loop: console lines, TensorBoard pages, videos, and one JSON line per round."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.config import Config
from bayessim_mjx.logs import Channels
from bayessim_mjx.loop import LoopState, RoundInfo
from bayessim_mjx.monitor import plots, video
from bayessim_mjx.monitor.clock import CompileClock
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.film import FPS, Motion, frames
from bayessim_mjx.monitor.opening import exact
from bayessim_mjx.monitor.writers import Wall, Writer, opened
from bayessim_mjx.rl import Policy, policy_of

MOST_PAIRS = 10  # BayesSimIG draws one figure per pair; beyond this the corner plot shows them all
ROUNDS = "rounds.jsonl"
SPEED = "Perf/total_fps"
SHOWN = (
    "Train/mean_reward", "Train/mean_episode_length", SPEED, "Loss/kl", "Loss/learning_rate", "Loss/value",
    "Loss/explained_variance", "Policy/mean_std",
)  # fmt: skip

SETTINGS = "BayesSim/cfg"
Film = Callable[[Policy, int, np.ndarray], Motion]  # (policy, control steps, theta [d]) -> one episode


class Session:
    """The monitor of a run. Steps in TensorBoard: rounds done (`bsim`), PPO iterations (`rl`), seconds (`rl_time`).

    Args:
        path: the run's folder.
        film: the episode of a policy at theta, for videos; None: no videos.
        start: the state that the run begins with; None: the very first.
        resumed_at: on --resume the second of its checkpoint (`Wall.mark`; -1: it had none yet), so that nothing that
            is about to be written again stays; None for a new run.
        truth: theta [d] of the surrogate real, which the videos show. Without one they show the posterior's mean.
    """

    def __init__(
        self,
        path: Path,
        config: Config,
        env: Any,
        console: Console,
        film: Film | None = None,
        start: LoopState | None = None,
        resumed_at: int | None = None,
        truth: np.ndarray | None = None,
    ):
        self.path, self.config, self.env, self.console, self.film = path, config, env, console, film
        self.compiling = CompileClock()
        first_round = 0 if start is None else int(start.round)
        done = 0 if start is None else self._overall(first_round, int(start.train.iteration))
        late = None if resumed_at is None else {SETTINGS: 0, "": first_round + 1}  # the settings are written again
        more = config.monitor.writers
        self.inference: Writer = opened(path / "bsim", late, path / "pictures", more, path)
        self.learning: Writer = opened(path / "rl", None if late is None else done + 1, path / "videos", more, path)
        self.wall = Wall(path, resumed_at, writers=more)
        self.filmed = done // self._film_every()
        self._show_physics(env.space.nominal if truth is None else truth)
        if truth is None and start is not None and first_round:
            self._show_posterior(start.domain)
        self._drop_rounds(first_round)
        console.begin(config.bayessim.realIters, first_round, at_most=config.bayessim.untilSettled)
        self._phase(first_round, done)

    def _phase(self, round_: int, done: int = 0) -> None:
        """Training of `round_` begins, with `done` iterations of it behind (resume)."""
        n = self.config.ppo.max_iterations
        if round_ < self.config.bayessim.realIters and n:
            self.console.phase("training", n, max(0, done - round_ * n))

    def _film_every(self) -> int:
        """PPO iterations between videos of the training."""
        return max(1, self.config.monitor.video_interval // self.config.ppo.num_steps)

    def _show_physics(self, theta: Any) -> None:
        """Videos from now on are made at theta [d], and of a model that looks so."""
        self.theta = np.asarray(theta, np.float32)
        self.model = None if self.film is None else video.model_at(self.env, self.theta)

    def _show_posterior(self, posterior: Any) -> None:
        if posterior is not None and self.film is not None:
            self._show_physics(posterior.mean())

    def describe(self, text: str) -> None:
        """Write the resolved settings as text, once."""
        self.inference.text(SETTINGS, text, code=True)

    def training(self, round_: int, metrics: dict[str, float], state: LoopState) -> None:
        slowed = self.compiling.report(self.console, "the training")
        iteration = self._overall(round_, int(state.train.iteration))
        self.learning.scalars(iteration, {tag if "/" in tag else f"Perf/{tag}": v for tag, v in metrics.items()})
        self.wall.scalars(metrics)
        shown = {tag: metrics[tag] for tag in SHOWN if tag in metrics and not (slowed and tag == SPEED)}
        self.console.iteration(shown, iteration - round_ * self.config.ppo.max_iterations)
        if self.film is not None and iteration // self._film_every() > self.filmed:
            self.filmed = iteration // self._film_every()
            title = f"{self.config.task}, training iteration {iteration}"
            self._video(self.learning, "Train/video", policy_of(state.train), iteration, title, half=True)

    def part(self, round_: int, name: str) -> None:
        """Begin a part of the round after training."""
        self.console.phase(name)

    def _overall(self, round_: int, iteration: int) -> int:
        """One axis over all rounds, also where every round trains a new policy."""
        return iteration if self.config.bayessim.ftuneRL else round_ * self.config.ppo.max_iterations + iteration

    def round(self, info: RoundInfo, policy: Policy) -> None:
        self.compiling.report(self.console, "evaluation, simulation and inference")
        self.console.phase("drawing the pictures")
        step = info.round + 1
        side = "Domain/rewards" if info.truth is None else "SurrogateReal/real_rewards"
        scalars = {f"{side}_{name}": getattr(np, name)(info.returns) for name in ("mean", "min", "max", "std")}
        scalars |= {f"BayesSim/{name}": value for name, value in info.scores.items()}
        scalars |= {f"Perf/{name}_seconds": value for name, value in info.seconds.items()}
        scalars |= fit_scalars(info.fit)
        scalars |= {} if info.checks is None else {f"BayesSim/{n}": v for n, v in info.checks.scalars.items()}
        self.inference.scalars(step, scalars)
        if self.config.monitor.posterior_plots:
            self._plots(info)
        if info.truth is None:
            self._show_posterior(info.posterior)
        if self.film is not None:
            physics = "posterior mean" if info.truth is None else "surrogate real"
            title = f"{self.config.task}, {physics}, round {step}"
            self._video(self.inference, f"{side.split('/')[0]}/video", policy, step, title)
        self._note(info)
        self.console.round_line(**round_line(info))
        if info.checks is not None:
            self.console.say(info.checks.sentence())
        if info.sets is not None:
            start = ", a start for the replays" if info.refinement is not None and info.refinement.used else ""
            self.console.say(f"product of the network's posteriors{start}: {info.sets.sentence()}")
        if info.refinement is not None:
            self.console.say(f"posterior: {info.refinement.sentence()}")
            self.inference.text("BayesSim/refinement", info.refinement.sentence(), step)
        if info.set_posterior is not None:
            self.console.say(f"posterior: {info.set_posterior.sentence()}")
            self.inference.text("BayesSim/set_posterior", info.set_posterior.sentence(), step)
        for text in info.warnings:
            self.console.warning(text)
        if info.moves:
            self.inference.text("BayesSim/range_ends", "\n\n".join(p.sentence() for p in info.moves), info.round + 1)
        self.flush()
        self.compiling.take()  # the plots' small programs get no line
        if info.settled:
            self.console.say(info.settled)
        else:
            self._phase(info.round + 1)

    def _plots(self, info: RoundInfo) -> None:
        posterior = info.posterior
        if posterior is None:
            return
        step, names = info.round + 1, posterior.space.names
        if info.checks is not None:
            replaced = info.refinement is not None and info.refinement.used
            picture = plots.calibration(info.checks.calibration, round=step, sets=info.sets, replaced=replaced)
            self.inference.figure("BayesSim/calibration", picture, step)
        self.inference.figure("BayesSim/posterior", plots.corner(posterior, truth=info.truth, round=step), step)
        pairs = list(itertools.combinations(range(len(names)), 2))
        for i, j in pairs if 1 < len(pairs) <= MOST_PAIRS else []:  # of two parameters the corner shows all
            figure = plots.pair(
                posterior, i, j, truth=info.truth, log_gain=info.scores.get("gain_over_prior"), round=step
            )
            self.inference.figure(f"BayesSim/posterior_{names[i]}_vs_{names[j]}", figure, step)
        if info.predictive is not None and info.real is not None:
            real, simulated = channels(self.env.mj_model, info)
            clock = np.arange(info.real.qpos.shape[1]) * self.env.dt
            # a surrogate whose sensors add nothing is seen as it moves
            own = "true motion" if exact(self.config, self.env) else "real"
            picture = plots.predictive(clock, real, simulated, units=units(self.env.mj_model), round=step, own=own)
            self.inference.figure("BayesSim/posterior_predictive", picture, step)

    def _video(self, writer: Writer, tag: str, policy: Policy, step: int, title: str, half: bool = False) -> None:
        assert self.film is not None
        shown = self.film(policy, self.config.monitor.video_length, self.theta)
        writer.video(tag, frames(self.model, shown, self.config.monitor, title, half=half), FPS, step)

    def _note(self, info: RoundInfo) -> None:
        """rounds.jsonl: the numbers of every round, for scripts."""
        row = {
            "round": info.round + 1,  # as the console counts
            "returns": {"mean": float(info.returns.mean()), "sd": float(info.returns.std()), "n": len(info.returns)},
            "scores": info.scores,
            "seconds": {name: float(value) for name, value in info.seconds.items()},
            "warnings": info.warnings,
        }
        if info.posterior is not None:
            row["posterior"] = info.posterior.describe()
            row["prior_share"] = float(info.posterior.prior_weight)  # kept beside what `posterior` describes
        if info.checks is not None:
            row["checks"] = info.checks.to_dict()
        if info.refinement is not None:
            row["refinement"] = info.refinement.to_dict()
        if info.set_posterior is not None:
            row["set_posterior"] = info.set_posterior.to_dict()
        if info.moves:
            row["range_ends"] = [pile.to_dict() for pile in info.moves]
        with open(self.path / ROUNDS, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def _drop_rounds(self, first: int) -> None:
        """On resume: rounds after the first `first` will be written again."""
        file = self.path / ROUNDS
        if file.exists():
            rows = [line for line in file.read_text(encoding="utf-8").splitlines() if _round_of(line) <= first]
            atomic.write_text(file, "".join(row + "\n" for row in rows))

    def flush(self) -> None:
        """Bring everything to the disk; before a checkpoint, as what lies before it is not written again."""
        for writer in (self.inference, self.learning, self.wall):
            writer.flush()

    def close(self) -> None:
        for writer in (self.inference, self.learning, self.wall):
            writer.close()


def _round_of(line: str) -> float:
    try:
        return float(json.loads(line)["round"])
    except (ValueError, KeyError, TypeError):
        return float("inf")  # a line cut short by a kill


def fit_scalars(fit: dict[str, Any]) -> dict[str, float]:
    """BayesSimIG's tags for the losses of the inference network (last point of each curve) and its held-out scores."""
    if not fit:
        return {}
    last = {"BayesSim/train_loss": fit["train_loss"][-1], "BayesSim/test_loss": np.min(fit["val_loss"])}
    return last | {
        f"BayesSim/held_out_{name}": fit[name] for name in ("log_q", "gain_truncated", "inside") if name in fit
    }


def channels(mj_model: Any, info: RoundInfo) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Measured positions and velocities by name: real [T+1], simulated [n, T+1]; NaN after the end of an episode."""
    assert info.real is not None and info.predictive is not None
    valid = np.concatenate([[True], np.asarray(info.real.valid[0]) > 0])
    real, simulated, named = {}, {}, Channels.of(mj_model)
    for kind in ("qpos", "qvel"):
        for k, channel in enumerate(getattr(named, kind)):
            name = f"{kind}:{channel}"
            real[name] = np.where(valid, np.asarray(getattr(info.real, kind))[0, :, k], np.nan)
            simulated[name] = np.where(valid, info.predictive[kind][:, :, k], np.nan)
    return real, simulated


def units(mj_model: Any) -> dict[str, str]:
    """{channel: unit}, named as in `channels`; quaternions have none."""
    named = Channels.of(mj_model)
    by_kind = {
        "hinge": ("rad",), "slide": ("m",), "ball": ("", "", "", "", "rad/s", "rad/s", "rad/s"),
        "free": ("m",) * 3 + ("",) * 4 + ("m/s",) * 3 + ("rad/s",) * 3,
    }  # fmt: skip
    found: dict[str, str] = {}
    for joint, kind in zip(named.joints, named.kinds, strict=True):
        own = [f"{stream}:{channel}" for stream in ("qpos", "qvel") for channel in named.of_joint(joint, stream)]
        unit = by_kind[kind]
        found |= dict(zip(own, unit if len(unit) > 1 else (unit[0], f"{unit[0]}/s"), strict=True))
    return {channel: unit for channel, unit in found.items() if unit}


def round_line(info: RoundInfo) -> dict[str, Any]:
    """List the numbers of the console's line for a round; a width is posterior sd / prior sd, narrowest first."""
    widths = {}
    if info.posterior is not None:
        relative = info.posterior.estimates().width
        widths = dict(sorted(zip(info.posterior.space.names, relative.tolist(), strict=True), key=lambda item: item[1]))
    return {
        "round": info.round,
        "rounds": info.rounds,
        "reward": (float(info.returns.mean()), float(info.returns.std())),
        "where": "simulated" if info.truth is None else "real",
        "gain": info.scores.get("gain_over_prior"),
        "widths": widths,
        "seconds": sum(info.seconds.values()),
        "ends": bool(info.settled),
    }
