"""Make the film of every task, docs/pictures/tasks/<task>.gif, at most 200 kB each.

    python docs/make_films.py [--only pendulum cartpole] [--runs FOLDER]

A film shows, whichever there is first: the best policy of the task's newest run in FOLDER, the policy that comes with
the package, or, without any policy, the robot while its actuators are moved to and fro (MuJoCo alone). films.json says
which, and so does docs/tasks.md. Needs OpenGL (EGL or OSMesa).
"""

import argparse
import itertools
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from PIL import Image

from bayessim_mjx import cli, registry
from bayessim_mjx.config import load
from bayessim_mjx.config.settings import MonitorConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor import film
from bayessim_mjx.rl import pretrained

FOLDER = Path(__file__).parent / "pictures" / "tasks"
PAGE = Path(__file__).with_name("tasks.md")
LARGEST, SECONDS, WIDTH, HEIGHT, FPS = 200_000, 5.0, 280, 210, 15
LENGTHS = ((SECONDS, FPS), (SECONDS, 12.5), (3.5, 12.5), (3.0, 12.5), (3.0, 10))  # s and frames/s, tried in turn
SWAY, PERIOD = 0.15, 2.0  # share of a range by which a command moves to and fro; s
FALLEN = 0.4  # by which share of its height a robot falls or rises until its film begins anew
COLOURS = (64, 40, 24)  # tried with each of these until the film is small enough
FILTER = "[0:v]fps={fps}[a];[a][1:v]paletteuse=dither=none:diff_mode=rectangle"


class Swaying(film.Motion):
    """Motion that nobody rewards."""

    def captions(self) -> list[str]:
        return [f"{self.dt * k:.2f} s" for k in range(len(self.qpos))]


@dataclass(frozen=True)
class Episodes(film.Motion):
    """Several episodes, one after the other."""

    lines: tuple[str, ...] = ()

    def captions(self) -> list[str]:
        return list(self.lines)


def of_run(task: str, folder: Path) -> tuple[film.Motion, Any, str]:
    """(motion, model, what it shows) of the best policy of the newest run."""
    path, run = cli.find_checkpoint("best", task, str(folder))
    assert run is not None
    env: Any = registry.make(task, config=run.config)
    shown = _acting(env, cli.load_policy(path, env, run.config))
    return shown, env.mj_model, f"{int(path.name)} updates of PPO"


def of_package(task: str) -> tuple[film.Motion, Any, str]:
    """(motion, model, what it shows) of the policy that comes with the package."""
    env: Any = registry.make(task, config=load(task))
    return _acting(env, pretrained.pretrained(task)), env.mj_model, "the package's policy"


def _acting(env: Any, policy: Any) -> film.Motion:
    """Run an episode, or as many as fill the film."""
    theta, shown, steps = jnp.asarray(env.space.nominal, jnp.float32), [], round(SECONDS / env.dt)
    while sum(len(one.total) for one in shown) < steps:
        key = jax.random.PRNGKey(len(shown))
        shown.append(film.motion(env, policy, key, theta, min(steps, env.episode_length)))
    if len(shown) == 1:
        return shown[0]
    qpos, total = (np.concatenate([getattr(one, name) for one in shown]) for name in ("qpos", "total"))
    marks = None if shown[0].mocap is None else np.concatenate([one.mocap for one in shown])
    return Episodes(qpos, total, shown[0].dt, mocap=marks, lines=tuple(x for one in shown for x in one.captions()))


def swaying(task: str) -> tuple[film.Motion, Any, str]:
    """(motion, model, what it shows) of actuators that are moved to and fro around where the robot stands."""
    env: Any = registry.make(task, config=load(task))
    model = env.mj_model
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    rest, (low, high) = data.ctrl.copy(), model.actuator_ctrlrange.T
    for k in range(model.nu):  # a servo holds the pose that it begins with
        if model.actuator_biasprm[k, 1] and model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT:
            rest[k] = data.qpos[model.jnt_qposadr[model.actuator_trnid[k, 0]]]
    poses, begun = [data.qpos.copy()], (data.qpos.copy(), data.ctrl.copy())
    free = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, model.nu)
    for k in range(round(SECONDS * FPS)):
        wave = np.sin(2 * np.pi * k / FPS / PERIOD + phases) - np.sin(phases)
        limited = model.actuator_ctrllimited.astype(bool)
        data.ctrl[:] = np.where(limited, np.clip(rest + SWAY * (high - low) * wave, low, high), rest)
        mujoco.mj_step(model, data, round(1 / FPS / model.opt.timestep))
        if free and abs(data.qpos[2] / begun[0][2] - 1) > FALLEN:  # as an episode that ends and begins anew
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.ctrl[:] = begun
        poses.append(data.qpos.copy())
    shown = np.stack(poses)
    return Swaying(shown, np.zeros(len(shown)), 1 / FPS), model, "no policy: its actuators are moved to and fro"


def motion_of(task: str, runs: Path | None) -> tuple[film.Motion, Any, str]:
    """Record what there is to show of a task."""
    if runs is not None:
        try:
            return of_run(task, runs)
        except UserError as error:
            print(f"{task}: {error}")
    return of_package(task) if task in pretrained.names() else swaying(task)


def palette(frames: np.ndarray, count: int) -> np.ndarray:
    """Choose the colours [count, 3] of a film, by k-means over the square roots of how often each is there.

    Going by the pixels alone, the tones of the ground would leave nothing for a small ball or the robot's body.
    """
    sample = frames[:: max(1, len(frames) // 12), ::2, ::2].reshape(-1, 3)
    _, which, often = np.unique(sample // 8 @ [1024, 32, 1], return_inverse=True, return_counts=True)
    colours = np.stack([np.bincount(which, channel) for channel in sample.T], axis=1) / often[:, None]
    weight = np.sqrt(often)
    chosen = colours[[weight.argmax()]]
    for _ in range(count - 1):  # each begins where most is far from all before
        far = ((colours[:, None] - chosen) ** 2).sum(-1).min(1)
        chosen = np.vstack([chosen, colours[(weight * far).argmax()]])
    for _ in range(20):
        nearest = ((colours[:, None] - chosen) ** 2).sum(-1).argmin(1)
        for k in np.unique(nearest):
            chosen[k] = np.average(colours[nearest == k], axis=0, weights=weight[nearest == k])
    return chosen.round().astype(np.uint8)


def gif(frames: np.ndarray, path: Path) -> int:
    """Write frames [T, H, W, 3] at 25 frames a second with as many colours as fit; bytes of the file.

    Where the camera moves along, all of the picture changes: such films are rather shorter than a row of stills.
    """
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", f"{film.FPS}", "-i", "-"]
    with tempfile.TemporaryDirectory() as folder:
        colours = Path(folder) / "colours.png"
        for (seconds, fps), count in itertools.product(LENGTHS, COLOURS):
            shown = frames[: round(seconds * film.FPS)]
            few = palette(shown, count)
            Image.fromarray(few[np.arange(256) % count].reshape(16, 16, 3)).save(colours)
            words = ["-i", str(colours), "-filter_complex", FILTER.format(fps=fps), "-loop", "0", str(path)]
            command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *words]
            subprocess.run(command, input=shown.tobytes(), check=True, capture_output=True)
            if path.stat().st_size <= LARGEST:
                break
    return path.stat().st_size


def make(task: str, runs: Path | None) -> str | None:
    """Film one task; what the film shows, None where nothing can be drawn."""
    shown, model, words = motion_of(task, runs)
    frames = film.frames(model, shown, MonitorConfig(video_width=WIDTH, video_height=HEIGHT), task)
    if frames is None:
        return None
    path = FOLDER / f"{_snake(task)}.gif"
    print(f"{path}: {gif(frames, path) / 1000:.0f} kB, {words}")
    return words


def captioned(page: str, shown: dict[str, str]) -> str:
    """Write the page of films, with what each of them shows."""
    for task, words in shown.items():
        page = re.sub(rf"(\*\*{task}\*\*: .*Shown: ).*?\.( \|)", rf"\g<1>{words}.\g<2>", page)
    return page


def _snake(task: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in task).lstrip("_")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", metavar="TASK", default=list(registry.names()), help="tasks (default: all)"
    )
    parser.add_argument("--runs", type=Path, help="folder of runs whose policies are shown")
    args = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    index = FOLDER / "films.json"
    shown = json.loads(index.read_text()) if index.exists() else {}
    for task in args.only:
        words = make(cli.task_name(task), args.runs)
        if words is None:
            sys.exit("nothing can be drawn here: no EGL, no OSMesa")
        shown[cli.task_name(task)] = words
        index.write_text(json.dumps(dict(sorted(shown.items())), indent=1) + "\n")
    PAGE.write_text(captioned(PAGE.read_text(encoding="utf-8"), shown), encoding="utf-8")


if __name__ == "__main__":
    main()
