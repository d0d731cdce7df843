"""A folder ready for a model hub: policy.onnx, config.yaml, and README.md, a card with metadata and returns."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx import config as settings
from bayessim_mjx.config import Config, to_yaml
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import estimate
from bayessim_mjx.rl import export
from bayessim_mjx.rl.networks import Policy

OWN = ("policy.onnx", "config.yaml", "README.md")
CARD = """---
{metadata}---

# {task}, a policy of bayessim_mjx

A policy for the task {task} of [bayessim_mjx](https://github.com/bayessim-mjx/bayessim_mjx), trained by PPO on
MuJoCo MJX.

| physics | return over {episodes} episodes |
|---|---|
{rows}

The return is the mean and the standard deviation between episodes. The policy acts without exploration.

## Files

- `policy.onnx`: observation in SI units [batch, {observations}] to action in [-1, 1] [batch, {actions}]; normaliser and
  limits are inside. Names, scales, the control period ({dt:g} s) and pairs for a check of your machine are in its
  metadata.
- `config.yaml`: all settings of the training.

```python
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession("policy.onnx")
{inputs}
action = session.run(["action"], inputs)[0]
```

The command was:

```
{command}
```
"""

# of this machine, before a file's name
FOLDERS = re.compile(r"(?<![^\s='\"])(?:~|[A-Za-z]:)?[/\\](?:[^\s/\\:]+[/\\])*")


def write(
    folder: Path, policy: Policy, env: Env, config: Config, returns: Mapping[str, Any], command: str = ""
) -> float | None:
    """Write the folder; the largest difference of the ONNX file to the policy, None without onnxruntime.

    Args:
        folder: is made; other files in it stay.
        policy, env: the policy and the environment that it acts in.
        config: settings of its training. Folders of this machine are left out.
        returns: {kind of physics: returns [episodes]}; the first is the card's metric.
        command: what trained it.

    Raises:
        UserError: the folder holds one of these files already, or onnx is not installed.
    """
    if there := [name for name in OWN if (folder / name).exists()]:
        raise UserError(f"--hub {folder}: {', '.join(there)} there already; give a new folder")
    error = export.write(folder / "policy.onnx", policy, env)
    plain = settings.replace(config, logdir="logs", cache_dir=None).to_dict()
    (folder / "config.yaml").write_text(to_yaml(plain), encoding="utf-8")
    (folder / "README.md").write_text(card(policy, env, config.task, returns, command), encoding="utf-8")
    return error


def card(policy: Policy, env: Env, task: str, returns: Mapping[str, Any], command: str = "") -> str:
    """Write the text of README.md: metadata as model hubs read them, returns, and how the file is run."""
    golden = export.golden_inputs(policy, env)
    zeros = [f'"{name}": np.zeros((1, {x.shape[1]}), np.float32)' for name, x in golden.items()]
    first, episodes = next(iter(returns.values())), len(next(iter(returns.values())))
    rows = [f"| {kind} | {estimate(r.mean(), r.std())} |" for kind, r in returns.items()]
    return CARD.format(
        metadata=to_yaml(_metadata(task, float(first.mean()))),
        task=task,
        episodes=episodes,
        rows="\n".join(rows),
        observations=golden["observation"].shape[1],
        actions=export.answer(policy, golden).shape[1],
        dt=env.dt,
        inputs=f"inputs = {{{', '.join(zeros)}}}",
        command=FOLDERS.sub("", command) or "unknown",
    )


def _metadata(task: str, mean: float) -> dict[str, Any]:
    metric = {"type": "mean_reward", "name": "mean return", "value": round(mean, 2)}
    kind = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    result = {"task": kind, "dataset": {"name": task, "type": task}, "metrics": [metric]}
    return {
        "library_name": "bayessim_mjx",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "robotics", "mujoco", "onnx", task],
        "model-index": [{"name": f"{task}-ppo", "results": [result]}],
    }
