"""`python -m bayessim_mjx.train --task Ant`: PPO alone, on nominal physics or (`--randomize`) on the prior."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config, to_yaml
from bayessim_mjx.device import setup_jax

DESCRIPTION = "PPO alone: on nominal physics, or on physics drawn from the prior with --randomize."

SPEED, WORTH_SAYING = "Perf/total_fps", 0.5  # seconds of compilation
PLAY = "python -m bayessim_mjx.play"
SHOWN = ("Train/mean_reward", "Train/mean_episode_length", SPEED, "Loss/value", "Loss/kl", "Loss/learning_rate")


def _parser() -> cli.Parser:
    parser = cli.Parser("train", DESCRIPTION, resume=True)
    parser.add_argument("--randomize", action="store_true", help="draw the physics of every episode from the prior")
    return parser


class Training:
    """PPO with an evaluation and a checkpoint every `ppo.save_interval` iterations; "best" is by evaluation."""

    def __init__(self, config: Config, env: Any, run: Any, writer: Any, console: Any, stop: cli.Stop):
        import jax
        import jax.numpy as jnp

        from bayessim_mjx.distributions import Distribution
        from bayessim_mjx.main import film
        from bayessim_mjx.monitor.compile_clock import CompileClock

        self.config, self.env, self.run, self.writer, self.console, self.stop = config, env, run, writer, console, stop
        randomized = bool(config.randomization.get("randomize")) and len(env.space) > 0
        self.domain = Distribution.prior(env.space, 1) if randomized else None
        self.key, self.evaluation_key = jax.random.split(jax.random.PRNGKey(config.seed))
        self.compiling, self.filmed = CompileClock(), 0
        nominal = jnp.asarray(env.space.nominal, jnp.float32)[None]
        self.film = film(env, config, nominal)  # None: no videos

    def state(self) -> Any:
        """A new training state."""
        from bayessim_mjx import rl

        return cli.warm_start(rl.init(self.env, self.config.ppo, self.key, self.domain), self.config, self.env)

    def tree(self, state: Any) -> dict[str, Any]:
        """What a checkpoint holds."""
        from bayessim_mjx import rl

        return {"policy": rl.policy_of(state), "state": state}

    def progress(self, metrics: dict[str, Any], state: Any) -> None:
        iteration = int(state.iteration)
        self.writer.scalars(iteration, {tag if "/" in tag else f"Perf/{tag}": v for tag, v in metrics.items()})
        seconds, cached = self.compiling.take()
        if slowed := seconds > WORTH_SAYING:
            self.console.compile("training", seconds, cached)
        shown = {tag: metrics[tag] for tag in SHOWN if tag in metrics and not (slowed and tag == SPEED)}
        self.console.iteration(shown, iteration)
        self._video(iteration, state)
        self.stop.save(lambda: self.run.save(iteration, self.tree(state)))

    def _video(self, iteration: int, state: Any) -> None:
        """An episode at nominal physics every `monitor.video_interval` steps, and at the end."""
        from bayessim_mjx.monitor import video
        from bayessim_mjx.rl import policy_of

        ppo, monitor = self.config.ppo, self.config.monitor
        every = max(1, monitor.video_interval // ppo.num_steps)
        if self.film is None or not (iteration // every > self.filmed or iteration >= ppo.max_iterations):
            return
        self.filmed = iteration // every
        frames = video.record(
            self.env.mj_model, self.film(policy_of(state), monitor.video_length), dt=self.env.dt, fps=25
        )
        self.writer.video("Train/video", frames, 25, iteration)

    def evaluate(self, state: Any) -> float:
        """Mean return of deterministic episodes, the same worlds at every evaluation; logged."""
        import jax
        import jax.numpy as jnp

        from bayessim_mjx import rl

        key, count = self.evaluation_key, self.config.ppo.eval_episodes
        nominal = jnp.tile(jnp.asarray(self.env.space.nominal, jnp.float32), (count, 1))
        thetas = nominal if self.domain is None else self.domain.sample(key, count)
        result = rl.evaluate(self.env, rl.policy_of(state), jax.random.fold_in(key, 1), thetas)
        score = float(result["return"].mean())
        figures = {"Eval/mean_reward": score, "Eval/mean_episode_length": float(result["length"].mean())}
        self.writer.scalars(int(state.iteration), figures)
        seconds, cached = self.compiling.take()
        if seconds > WORTH_SAYING:
            self.console.compile("evaluation", seconds, cached)
        sd = float(result["return"].std())
        self.console.say(f"evaluation at {int(state.iteration)}: return {score:.4g} ± {sd:.4g} over {count} episodes")
        return score

    def train(self, state: Any) -> Any:
        """All iterations that are left."""
        from bayessim_mjx import rl

        ppo = self.config.ppo
        while (done := int(state.iteration)) < ppo.max_iterations:
            chunk = min(ppo.save_interval - done % ppo.save_interval, ppo.max_iterations - done)
            state, _ = rl.run(self.env, ppo, state, self.domain, iterations=chunk, progress=self.progress)
            self.run.save(int(state.iteration), self.tree(state), evaluation=self.evaluate(state))
            self.stop.save(lambda: None)
        return state


def _run(config: Config, run: Any, command: Sequence[str], headless: bool) -> int:
    from bayessim_mjx import registry, runs
    from bayessim_mjx.monitor.console import Console
    from bayessim_mjx.monitor.opening import opening
    from bayessim_mjx.monitor.writer import Writer

    device = setup_jax(config)
    with Console(headless=headless) as console, cli.graceful() as stop:
        env = registry.make(config.task, config=config)
        console.start(opening(config, env, device, infers=False))
        resumed = run is not None and bool(run.checkpoints)
        if run is None:
            run = runs.Run.create(config.logdir, config.task, config.name, config, command)
        run.set_status("running")
        console.say(f"run folder {run.path}")
        training = Training(config, env, run, None, console, stop)
        state = training.state()
        if resumed:
            state = run.restore("latest", training.tree(state), fall_back=True)[0]["state"]
        training.writer = Writer(run.path, int(state.iteration) + 1 if resumed else None, media=run.path / "videos")
        training.writer.text("cfg", to_yaml(config.to_dict()), code=True)
        console.phase("training", config.ppo.max_iterations, int(state.iteration))
        try:
            training.train(state)
        except KeyboardInterrupt:
            run.set_status("interrupted")
            console.say(f"interrupted; go on with --resume {run.path}")
            raise
        finally:
            training.writer.close()
        run.set_status("finished")
        console.say(f"best policy (step {run.manifest['best']}): {PLAY} --checkpoint {run.path} --video")
        console.say(f"curves: tensorboard --logdir {run.path}")
    return 0


def _train(argv: Sequence[str] | None) -> int:
    argv = list(sys.argv[1:] if argv is None else argv)
    args = _parser().parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    from bayessim_mjx.runs import Run

    command = ["python", "-m", "bayessim_mjx.train", *argv]
    if args.resume:
        run = Run.open(args.resume)
        return _run(cli.resumed_config(args, run.config), run, command, args.headless)
    more: dict[str, tuple[str, Any]] = {"--randomize": ("task.randomize", args.randomize)}
    if args.checkpoint:
        more["--checkpoint"] = ("bayessim.policyCheckpt", args.checkpoint)
    return _run(cli.pin_policy(cli.config_of(args, more)), None, command, args.headless)


main = cli.command(_train)

if __name__ == "__main__":
    sys.exit(main())
