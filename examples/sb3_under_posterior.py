"""Train with Stable-Baselines3 on nominal physics, a task's ranges or the posterior of a run; play it, and film it.

python examples/sb3_under_posterior.py --task Cartpole --domain prior
python examples/sb3_under_posterior.py --task logs/Pendulum/RUN --domain posterior --out logs/sb3/pendulum
python examples/sb3_under_posterior.py --task Cartpole --out logs/sb3/cartpole --play --video
"""

import argparse
from pathlib import Path
from typing import Any

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--task", default="Cartpole", help="a task, or the folder of a run")
parser.add_argument("--domain", default="nominal", help="nominal, prior, posterior (of the run), or a saved one's path")
parser.add_argument("--num_envs", type=int, default=64)
parser.add_argument("--timesteps", type=int, default=300_000, help="of all worlds together")
parser.add_argument("--out", type=Path, default=Path("logs/sb3/cartpole"))
parser.add_argument("--play", action="store_true", help="do not train: evaluate what is in --out")
parser.add_argument("--video", action="store_true", help="and film an episode, --out/episode.mp4")
args = parser.parse_args()  # --help works without the library

from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.callbacks import CheckpointCallback  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

from bayessim_mjx.wrappers import sb3  # noqa: E402

domain = None if args.domain == "posterior" else args.domain  # a run's own is its posterior
worlds = sb3.make(args.task, args.num_envs, domain)
model_file, scales = args.out / "model.zip", args.out / "scales.pkl"

if not args.play:
    env = VecNormalize(worlds, norm_reward=False)
    args.out.mkdir(parents=True, exist_ok=True)
    # 64 steps of each world an update: few enough that young policies are corrected often
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=5, learning_rate=1e-3, device="cpu", seed=0)
    saving = CheckpointCallback(100_000 // args.num_envs, str(args.out), "model", save_vecnormalize=True)
    model.learn(args.timesteps, callback=saving)
    model.save(model_file)
    env.save(str(scales))

env = VecNormalize.load(str(scales), worlds)
env.training = False  # the scales stay as they were learnt
model = PPO.load(model_file, env, device="cpu")
mean, spread = evaluate_policy(model, env, n_eval_episodes=args.num_envs)
print(f"return of {args.num_envs} episodes: {mean:.1f}, standard deviation {spread:.1f}")

if args.video:
    import numpy as np

    from bayessim_mjx.monitor import video

    one = VecNormalize.load(str(scales), sb3.make(args.task, 1, domain))
    one.training = False
    obs: Any = one.reset()
    frames: list[Any] = []
    for _step in range(300):
        obs, _reward, done, _infos = one.step(model.predict(obs, deterministic=True)[0])
        frames += one.get_images()
        if done[0]:
            break
    if frames[0] is not None and video.save(np.stack(frames), args.out / "episode.mp4", 1 / one.get_attr("dt")[0]):
        print(f"video: {args.out / 'episode.mp4'}")
