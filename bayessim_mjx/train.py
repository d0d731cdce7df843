"""`bayessim-mjx train --task Ant`: PPO alone, on nominal physics, the prior or (`--domain RUN`) a posterior.

`--distil RUN` trains a student of that run's policy instead.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import cli, trust
from bayessim_mjx.config import Config, to_yaml
from bayessim_mjx.config.settings import AGENTS
from bayessim_mjx.device import mesh, setup_jax
from bayessim_mjx.quantities import estimate

DESCRIPTION = "Train a policy with PPO alone, on nominal physics or on physics drawn from the prior or a posterior."

SPEED = "Perf/total_fps"
SHOWN = (
    "Train/mean_reward",
    "Train/mean_episode_length",
    SPEED,
    "Loss/value",
    "Loss/kl",
    "Loss/behavior",
    "Loss/learning_rate",
)


def _parser() -> cli.Parser:
    parser = cli.Parser("train", DESCRIPTION, resume=True, unused=("bayessim", "real"), but=("bayessim.policyCheckpt",))
    physics, learner = parser.group("physics"), parser.group("training")
    physics.add_argument("--randomize", action="store_true", help="draw the physics of each episode from the prior")
    about = "draw it from the posterior of this run, with its settings; or nominal, prior, a file of Distribution.save"
    physics.add_argument("--domain", metavar="RUN", help=f"{about} (default: nominal)")
    about = "train a student that imitates the policy of this run or checkpoint, instead of PPO"
    learner.add_argument("--distil", metavar="RUN", help=about)
    learner.add_argument("--agent", choices=AGENTS, help="whose PPO trains (default: own; docs/trainers.md)")
    return parser


class Training:
    """PPO with an evaluation and a checkpoint every `ppo.save_interval` iterations; "best" is by evaluation."""

    writer: Any  # TensorBoard by PPO iterations
    wall: Any  # and by seconds

    def __init__(self, config: Config, env: Any, run: Any, console: Any, stop: cli.Stop):
        import jax

        from bayessim_mjx.monitor.clock import CompileClock
        from bayessim_mjx.monitor.film import film
        from bayessim_mjx.wrappers.worlds import domain_of

        self.env, self.teacher = cli.privileged(config, env)
        self.config, self.run, self.console, self.stop = config, run, console, stop
        prior = "prior" if config.randomization.get("randomize") else None
        self.domain = domain_of(env, config.domain or prior)
        self.key, self.evaluation_key = jax.random.split(jax.random.PRNGKey(config.seed))
        self.compiling, self.filmed = CompileClock(), 0
        self.not_finite: dict[str, int] = {}  # what the user has been warned of
        self.film = film(self.env, config)  # None: no videos

    def state(self, resume: bool) -> tuple[Any, int | None]:
        """(state to begin with, second of the run's clock that its checkpoint lies at: -1 none yet, None a new run)."""
        from bayessim_mjx import rl
        from bayessim_mjx.monitor.writers import marked

        state = rl.start(self.env, self.config.ppo, self.key, self.domain, mesh(self.config), self.teacher)
        if resume and self.run.checkpoints:
            tree, meta = self.run.restore("latest", self.tree(state), fall_back=True)
            return tree["state"], marked(meta)
        return cli.warm_start(state, self.config, self.env, self.console.say), -1 if resume else None

    def open(self, iteration: int, resumed_at: int | None) -> None:
        """Begin to write; on resume what lies after the checkpoint goes, as it is written again."""
        from bayessim_mjx.monitor.writers import Wall, opened

        path, late = self.run.path, None if resumed_at is None else {"cfg": 0, "": iteration + 1}
        more = self.config.monitor.writers
        self.writer = opened(path, late, path / "videos", more, path)
        self.wall = Wall(path, resumed_at, writers=more)
        self.filmed = iteration // self._film_every()
        self.writer.text("cfg", to_yaml(self.config.to_dict()), code=True)

    def close(self) -> None:
        self.writer.close()
        self.wall.close()

    def policy(self, state: Any) -> Any:
        """Return the policy now."""
        from bayessim_mjx import rl

        return rl.policy_of(state)

    def tree(self, state: Any) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        return {"policy": self.policy(state), "state": state}

    def progress(self, metrics: dict[str, Any], state: Any) -> None:
        iteration = int(state.iteration)
        self.writer.scalars(iteration, {tag if "/" in tag else f"Perf/{tag}": v for tag, v in metrics.items()})
        slowed = self.compiling.report(self.console, "the training")
        shown = {tag: metrics[tag] for tag in SHOWN if tag in metrics and not (slowed and tag == SPEED)}
        self.wall.scalars(metrics)
        self.console.iteration(shown, iteration)
        self._video(iteration, state)
        if iteration < self.config.ppo.max_iterations:  # else all is done but the evaluation
            self.stop.save(lambda: self.save(state))

    def save(self, state: Any, evaluation: float | None = None) -> None:
        """Save a checkpoint, with all that was written before it on the disk."""
        self.writer.flush()
        self.wall.flush()
        meta = {"iteration": int(state.iteration), "seconds": self.wall.mark()}
        self.run.save(int(state.iteration), self.tree(state), evaluation=evaluation, meta=meta)

    def _film_every(self) -> int:
        """PPO iterations between videos."""
        return max(1, self.config.monitor.video_interval // self.config.ppo.num_steps)

    def _video(self, iteration: int, state: Any) -> None:
        """Film an episode at nominal physics every `monitor.video_interval` steps, and at the end."""
        from bayessim_mjx.monitor.film import FPS, frames

        every, last = self._film_every(), iteration >= self.config.ppo.max_iterations
        if self.film is None or not (iteration // every > self.filmed or last):
            return
        self.filmed = iteration // every
        monitor, title = self.config.monitor, f"{self.config.task}, training iteration {iteration}"
        shown = self.film(self.policy(state), monitor.video_length, self.env.space.nominal)
        pictures = frames(self.env.mj_model, shown, monitor, title, half=not last)
        self.writer.video("Train/video", pictures, FPS, iteration)

    def evaluate(self, state: Any) -> float:
        """Mean return of deterministic episodes, the same worlds at every evaluation; logged."""
        import jax.numpy as jnp

        from bayessim_mjx import rl
        from bayessim_mjx.keys import branch

        key, count = self.evaluation_key, self.config.ppo.eval_episodes
        nominal = jnp.tile(jnp.asarray(self.env.space.nominal, jnp.float32), (count, 1))
        thetas = nominal if self.domain is None else self.domain.sample(key, count)
        result = rl.evaluate(self.env, self.policy(state), branch(key, 1), thetas)
        score = float(result["return"].mean())
        figures = {"Eval/mean_reward": score, "Eval/mean_episode_length": float(result["length"].mean())}
        self.writer.scalars(int(state.iteration), figures)
        self.compiling.report(self.console, "the evaluation")
        found = estimate(score, result["return"].std())
        drawn = "physics drawn from --domain" if self.config.domain else "physics drawn from the prior"
        physics = "nominal physics" if self.domain is None else drawn
        self.console.say(f"evaluation at {int(state.iteration)}: return {found} over {count} episodes on {physics}")
        return score

    def owes_evaluation(self, iteration: int) -> bool:
        """Whether the checkpoint here is to be evaluated and was not: Ctrl-C saves without."""
        ppo = self.config.ppo
        due = iteration >= ppo.max_iterations or (iteration > 0 and iteration % ppo.save_interval == 0)
        return due and not any(c["step"] == iteration and c["kind"] == "evaluated" for c in self.run.checkpoints)

    def train(self, state: Any) -> Any:
        """All iterations that are left; the last policy is evaluated in any case, so that it can become the best."""
        from bayessim_mjx import rl

        ppo = self.config.ppo
        if self.owes_evaluation(int(state.iteration)):
            self.save(state, self.evaluate(state))
        while (done := int(state.iteration)) < ppo.max_iterations:
            self.stop.check()
            chunk = min(ppo.save_interval - done % ppo.save_interval, ppo.max_iterations - done)
            more = {"progress": self.progress, "teacher": self.teacher, "seen": self.not_finite}
            state, _ = rl.run(self.env, ppo, state, self.domain, iterations=chunk, **more)
            self.save(state, self.evaluate(state))
        return state


class AgentTraining(Training):
    """The same with another library's PPO: `state` is the agent, whose own files lie in `agent/` beside checkpoints."""

    def state(self, resume: bool) -> tuple[Any, int | None]:
        from bayessim_mjx.monitor.writers import marked
        from bayessim_mjx.wrappers import agents
        from bayessim_mjx.wrappers.agents import shared

        agent = agents.make(self.config, self.env, self.domain)
        if not (resume and self.run.checkpoints):
            return agent, -1 if resume else None
        _, meta = self.run.restore("latest", {"policy": agent.policy()}, fall_back=True)
        agent.load(shared.kept_folder(self._folder(meta["iteration"])))
        agent.iteration = meta["iteration"]
        return agent, marked(meta)

    def policy(self, state: Any) -> Any:
        return state.policy()

    def tree(self, state: Any) -> dict[str, Any]:
        return {"policy": state.policy()}

    def _folder(self, iteration: int) -> Path:
        return self.run.path / "agent" / str(iteration)

    def save(self, state: Any, evaluation: float | None = None) -> None:
        """Save a checkpoint, after the agent's own files; older ones go."""
        from bayessim_mjx.wrappers.agents import shared

        folder = self._folder(state.iteration)
        shared.write_folder(folder, state.save)
        super().save(state, evaluation)
        shared.clear_folders(folder.parent, {str(c["step"]) for c in self.run.checkpoints})

    def train(self, state: Any) -> Any:
        ppo = self.config.ppo
        if self.owes_evaluation(state.iteration):
            self.save(state, self.evaluate(state))
        while (done := state.iteration) < ppo.max_iterations:
            self.stop.check()
            due = min(ppo.save_interval - done % ppo.save_interval, ppo.max_iterations - done)
            started, chunk = time.perf_counter(), min(ppo.log_interval, due)
            metrics = state.learn(chunk)
            metrics[SPEED] = chunk * ppo.num_steps * ppo.num_envs / (time.perf_counter() - started)
            self.progress(metrics, state)
            if chunk == due:
                self.save(state, self.evaluate(state))
        return state


def _run(config: Config, run: Any, command: Sequence[str], headless: bool) -> int:
    from bayessim_mjx import registry, runs
    from bayessim_mjx.monitor.console import Console
    from bayessim_mjx.monitor.opening import opening

    device = setup_jax(config)
    mesh(config)  # refuse before there is a run folder
    with cli.first_writes(config, run) as (config, run), Console(headless=headless) as console, cli.graceful() as stop:
        env = registry.make(config.task, config=config)
        if config.agent != "own":
            from bayessim_mjx.wrappers import agents

            agents.check(config, env)
        resume = run is not None
        other = "" if resume else cli.of_another_task(config, env)
        console.start(opening(config, env, device, infers=False))
        if other:
            console.warning(other)
        if run is None:
            run = runs.Run.create(config.logdir, config.task, config.name, config, command)
        else:
            cli.say_changes(run, console)
            run.prolong(config.ppo.max_iterations)
        console.say(f"run folder {run.path}")
        with cli.running(run, console.say):
            training = (Training if config.agent == "own" else AgentTraining)(config, env, run, console, stop)
            console.phase("compiling the training")
            state, resumed_at = training.state(resume)
            training.compiling.report(console, "the training")
            done = int(state.iteration)
            if done >= config.ppo.max_iterations and not training.owes_evaluation(done):
                console.say("this run had finished; --max_iterations N goes on with it, to N iterations in all")
            else:
                training.open(done, resumed_at)
                console.phase("training", config.ppo.max_iterations, done)
                try:
                    training.train(state)
                finally:
                    training.close()
        which = "latest" if run.manifest["best"] is None else f"best (step {run.manifest['best']})"
        console.command(f"{which} policy", f"{cli.prog_of('play')} --checkpoint {run.path}{trust.flags()} --video")
        console.command("curves", f"tensorboard --logdir {run.path}")
    return 0


def _train(argv: Sequence[str] | None) -> int:
    argv = list(sys.argv[1:] if argv is None else argv)
    args = _parser().parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    command = [cli.SCRIPT, "train", *argv]
    if args.resume:
        run = cli.run_to_resume(args.resume, "train")
        return _run(cli.prolonged_config(args, run), run, command, args.headless)
    more = cli.physics_settings(args)
    if args.agent:
        more["--agent"] = ("agent", args.agent)
    if args.distil:
        more["--distil"] = ("ppo.teacher", str(cli.find_checkpoint(args.distil, None, "")[0]))
    if args.checkpoint:
        more["--checkpoint"] = ("bayessim.policyCheckpt", args.checkpoint)
    config = cli.pin_policy(cli.config_of(args, more))
    cli.writable(config.logdir, "--logdir")
    return _run(config, None, command, args.headless)


main = cli.command(_train)

if __name__ == "__main__":
    sys.exit(main())
