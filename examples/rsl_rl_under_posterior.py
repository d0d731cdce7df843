"""Train with rsl_rl, random network distillation and symmetry on, under a task's ranges or the posterior of a run.

python examples/rsl_rl_under_posterior.py --task Cartpole --domain prior
python examples/rsl_rl_under_posterior.py --task logs/Ant/RUN --domain posterior --num_envs 1024
"""

import argparse

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--task", default="Cartpole", help="a task, or the folder of a run")
parser.add_argument("--domain", default="nominal", help="nominal, prior, posterior (of the run), or a saved one's path")
parser.add_argument("--num_envs", type=int, default=64)
parser.add_argument("--iterations", type=int, default=150)
parser.add_argument("--rnd", type=float, default=0.1, help="weight of the reward for what is new; 0: none")
parser.add_argument("--out", default="logs/rsl_rl/cartpole")
args = parser.parse_args()  # --help works without the library

from rsl_rl.runners import OnPolicyRunner  # noqa: E402

from bayessim_mjx.wrappers import rsl_rl  # noqa: E402

env = rsl_rl.make(args.task, args.num_envs, None if args.domain == "posterior" else args.domain)
settings = rsl_rl.settings(symmetry=bool(env.env.mirrors), rnd=args.rnd)
OnPolicyRunner(env, settings, log_dir=args.out, device=env.device).learn(args.iterations, init_at_random_ep_len=True)
