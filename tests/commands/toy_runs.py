"""A task that is quick to compile, small runs of it, what they leave, and how they are killed."""

import collections
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import pytest

from bayessim_mjx.env import Env, State
from bayessim_mjx.monitor.writer import event_files, records
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.runs import Run

SMALL = ["ppo.num_envs=4", "ppo.num_steps=4", "ppo.num_epochs=1", "ppo.num_minibatches=1", "ppo.hidden_actor=[4]"]
SMALL += [
    "ppo.hidden_critic=[4]",
    "ppo.log_interval=1",
    "ppo.save_interval=2",
    "ppo.eval_episodes=4",
    "--max_iterations=4",
]
SMALL += ["env.realParams.means=[[1.5]]", "env.realParams.stds=[[0.0]]", "--headless"]
LOOP = ["bayessim.realIters=2", "bayessim.trainTrajs=32", "bayessim.realEvals=4", "bayessim.components=2"]
LOOP += ["bayessim.hiddenLayers=[4]", "bayessim.trainTrajLen=4", "monitor.posterior_plots=False", "bayessim.refine=off"]


class Toy(Env):
    """A mass on a line, pushed: quick to compile."""

    name, backend, episode_length, dt, action_size = "Pendulum", "toy", 8, 0.1, 1
    space = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0)])
    mj_model = mujoco.MjModel.from_xml_string("<mujoco/>")

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        mass = (jnp.asarray(self.space.nominal) if theta is None else theta)[0]
        return self._state(jax.random.normal(key, (2,)), mass, jnp.int32(0), jnp.float32(0))

    def step(self, state: State, action: jax.Array) -> State:
        x, mass = state.pipeline_state["x"], state.pipeline_state["mass"]
        x = x + self.dt * jnp.stack([x[1], jnp.clip(action[0], -1, 1) / mass])
        return self._state(x, mass, state.info["steps"] + 1, -jnp.sum(x**2))

    def _state(self, x: jax.Array, mass: jax.Array, steps: jax.Array, reward: jax.Array) -> State:
        zero, late = jnp.float32(0), (steps >= self.episode_length).astype(jnp.float32)
        info = {"terminated": zero, "truncated": late, "final_observation": {"policy": x}, "steps": steps}
        return State({"x": x, "mass": mass}, {"policy": x}, reward, zero, {}, info)


TOY = Toy()


def error_of(capsys: pytest.CaptureFixture, run: Any, *argv: str) -> str:
    """The one line on stderr of a command that has to refuse."""
    assert run(list(argv)) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


def checkpoint_of(run: Run, step: int) -> list:
    """Names, shapes and checksums of everything in a checkpoint."""
    return json.loads((run.checkpoint(step) / "index.json").read_text())["parts"]


def repeated_events(run: Run) -> list:
    """(folder, tag, step) that the run's TensorBoard events hold more than once, in all folders."""
    folders = [run.path, *(run.path / name for name in ("bsim", "rl", "rl_time"))]
    count = collections.Counter(
        (folder.name, value.tag, event.step)
        for folder in folders
        for file in event_files(folder)
        for _, event in records(file)
        for value in event.summary.value
    )
    assert count
    return [key for key, n in count.items() if n > 1]


class Killed(BaseException):
    """Nothing catches it: what is on the disk now is what a SIGKILL leaves."""


def killed_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Run.save: complete `count` times, then die in the middle of the next one (half a folder, old manifest)."""
    whole, done = Run.save, []

    def save(self: Run, step: int, tree: Any, **options: Any) -> Path:
        if len(done) == count:
            (self.path / "checkpoints" / f"{step:09d}.1.tmp" / "state").mkdir(parents=True)
            raise Killed
        done.append(step)
        return whole(self, step, tree, **options)

    monkeypatch.setattr(Run, "save", save)
