"""Training files in the form of rl-pytorch, which came with Isaac Gym and which BayesSimIG's --cfg_train takes.

A section `policy:` of the networks, a section `learn:` of PPO, and a few keys beside them. What PPO has here under
another name is taken over, what means nothing here is named in one note, and any other key is refused.
"""

import warnings
from collections.abc import Mapping
from typing import Any

from bayessim_mjx.errors import UserError, unknown

TOP, POLICY, LEARN = "", "policy", "learn"
OURS = {  # section -> their key -> ours
    TOP: {"seed": "seed", "clip_actions": "ppo.action_clip"},
    POLICY: {"pi_hid_sizes": "ppo.hidden_actor", "vf_hid_sizes": "ppo.hidden_critic", "activation": "ppo.activation"},
    LEARN: {
        "max_iterations": "ppo.max_iterations",
        "save_interval": "ppo.save_interval",
        "log_interval": "ppo.log_interval",
        "cliprange": "ppo.clip_param",
        "ent_coef": "ppo.entropy_coef",
        "value_loss_coef": "ppo.value_loss_coef",
        "use_clipped_value_loss": "ppo.use_clipped_value_loss",
        "nsteps": "ppo.num_steps",
        "noptepochs": "ppo.num_epochs",
        "nminibatches": "ppo.num_minibatches",
        "max_grad_norm": "ppo.max_grad_norm",
        "optim_stepsize": "ppo.learning_rate",
        "schedule": "ppo.schedule",
        "desired_kl": "ppo.desired_kl",
        "gamma": "ppo.gamma",
        "lam": "ppo.gae_lambda",
        "init_noise_std": "ppo.init_std",
    },
}
NOTHING = {  # what means nothing here: observations are normalised in place of clipped, and flags do the others
    TOP: ("clip_observations", "task", "device", "torch_deterministic"),
    POLICY: (),
    LEARN: ("agent_name", "test", "resume", "print_log", "sampler", "asymmetric", "is_testing"),
}


def is_one(raw: Mapping[str, Any]) -> bool:
    """Whether a file has this form."""
    return POLICY in raw or LEARN in raw


def read(raw: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Read the file's settings under our names, nested; a warning names those that mean nothing here.

    Raises:
        UserError: a key that is none of theirs, or a section that is none.
    """
    found: dict[str, Any] = {}
    left_out = []
    for section in (TOP, POLICY, LEARN):
        for key, value in _keys(raw, section, source).items():
            name = f"{section}.{key}".lstrip(".")
            if key in NOTHING[section]:
                left_out.append(name)
            elif (ours := OURS[section].get(key)) is None:
                allowed = [f"{section}.{k}".lstrip(".") for k in (*OURS[section], *NOTHING[section])]
                raise unknown(f"{source}: key", name, allowed)
            else:
                outer, _, inner = ours.partition(".")
                found.setdefault(outer, {})[inner] = value  # a key of no section under the empty name
    if left_out:
        warnings.warn(f"{source}: left out, as they mean nothing here: {', '.join(left_out)}", stacklevel=3)
    return {key: value.get("", value) for key, value in found.items()}


def _keys(raw: Mapping[str, Any], section: str, source: str) -> Mapping[str, Any]:
    """Return the keys of a section; for the empty name those beside the sections."""
    if section == TOP:
        return {key: value for key, value in raw.items() if key not in (POLICY, LEARN)}
    content = raw.get(section) or {}
    if not isinstance(content, Mapping):
        raise UserError(f"{source}: {section} = {content!r}: expected a section of `key: value` lines")
    return content
