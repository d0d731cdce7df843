"""Files of BayesSimIG and Isaac Gym: keys of theirs that mean nothing here are named in one note, not refused.

Training files may have the form of rl-pytorch, as BayesSimIG's --cfg_train takes it: a section `policy:` of the
networks, a section `learn:` of PPO, and a few keys beside them. What PPO has here under another name is taken over.
Other unknown keys are refused as ever: they may be slips of the finger. What a task's own file lists is the task's.
"""

import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from bayessim_mjx.errors import UserError, unknown

TOP = ("sim", "rkhsnet", "physics_engine")
# of `env:`: looks, assets, PhysX, and weights and noises of rewards and resets, which are fixed in the tasks here
ENV = (
    "actionPenaltyScale", "actionScale", "actionSpeedScale", "actionsCost", "actionsMovingAverage", "aggregateMode",
    "angularVelocityScale", "aroundHandleRewardScale", "asset", "asymmetric_observations", "baseInitState",
    "clipActions", "clipObservations", "contactForceScale", "control", "controlFrequencyInv", "deathCost",
    "defaultJointAngles",
    "distRewardScale", "dofSpeedScale", "dofVelocityScale", "enableCameraSensors", "enableDebugVis", "energyCost",
    "envSpacing", "fallDistance", "fallPenalty", "fingerDistRewardScale", "forceDecay", "forceDecayInterval",
    "forceLimitScale", "forceProbRange", "forceScale", "headingWeight", "isFlagrun", "jointsAtLimitCost", "learn",
    "maxConsecutiveSuccesses", "maxEffort", "numProps", "objectType", "observationType", "openRewardScale", "plane",
    "powerScale", "printNumSuccesses", "randomCommandVelocityRanges", "reachGoalBonus", "resetDist",
    "resetDofPosRandomInterval", "resetDofVelRandomInterval", "resetPositionNoise", "resetRotationNoise", "rotEps",
    "rotRewardScale", "startPositionNoise", "startRotationNoise", "stiffnessScale", "successTolerance",
    "terminationHeight", "upWeight", "urdfAsset", "useDofForceSensors", "useRelativeControl", "viewer",
)  # fmt: skip
SIM_PARAMS = ("dt", "substeps", "up_axis", "num_client_threads", "use_gpu_pipeline", "physx", "flex")  # randomised
OF_PARAMETERS = ("num_buckets", "setup_only")  # values are continuous here, and new in every episode
LOOKS = "color"
BESIDE, POLICY, LEARN = "", "policy", "learn"
RLPT = {  # section -> their key -> ours
    BESIDE: {"seed": "seed", "clip_actions": "ppo.action_clip"},
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
RLPT_NOTHING = {  # what means nothing here: observations are normalised in place of clipped, and flags do the others
    BESIDE: ("clip_observations", "task", "device", "torch_deterministic"),
    POLICY: (),
    LEARN: ("agent_name", "test", "resume", "print_log", "sampler", "asymmetric", "is_testing"),
}


def note(raw: Mapping[str, Any], source: str, ours: Collection[str] = (), more: Collection[str] = ()) -> None:
    """One warning for all of a file's keys that mean nothing here.

    ours: the keys of `env:` that the task has; more: further names that the caller leaves out.
    """
    names = [*_top(raw, ours), *dict.fromkeys(_of_task(raw.get("task") if "task" in raw else raw)), *more]
    if names:
        warnings.warn(f"{source}: left out, as they mean nothing here: {', '.join(names)}", stacklevel=2)


def without(raw: Mapping[str, Any], ours: Collection[str]) -> dict[str, Any]:
    """Return the file's sections without these keys."""
    left = {key: value for key, value in raw.items() if key not in TOP}
    if isinstance(left.get("env"), Mapping):
        left["env"] = {k: v for k, v in left["env"].items() if k not in ENV or k in ours}
    if isinstance(left.get("task"), Mapping):
        left["task"] = _plain(left["task"])
    return left


def _plain(section: Any) -> Any:
    """Return a section of `task:` without them."""
    if not isinstance(section, Mapping):
        return section
    passed = (*OF_PARAMETERS, LOOKS)
    left = {key: _plain(value) for key, value in section.items() if key not in passed}
    if isinstance(left.get("sim_params"), Mapping):
        left["sim_params"] = {k: v for k, v in left["sim_params"].items() if k not in SIM_PARAMS}
    return left


def _top(raw: Mapping[str, Any], ours: Collection[str]) -> Iterator[str]:
    yield from (key for key in TOP if key in raw)
    env = raw.get("env")
    if isinstance(env, Mapping):
        yield from (f"env.{key}" for key in env if key in ENV and key not in ours)


def _of_task(section: Any) -> Iterator[str]:
    """Keys of randomised parameters, wherever they are; of each kind one."""
    if not isinstance(section, Mapping):
        return
    for key, value in section.items():
        if key == "sim_params" and isinstance(value, Mapping):
            yield from (f"sim_params.{name}" for name in value if name in SIM_PARAMS)
        elif key in OF_PARAMETERS and value:
            yield key
        elif key == LOOKS:
            yield LOOKS
        elif key not in ("observations", "actions"):
            yield from _of_task(value)


def is_rlpt(raw: Mapping[str, Any]) -> bool:
    """Whether a file has this form."""
    return POLICY in raw or LEARN in raw


def read_rlpt(raw: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Read the file's settings under our names, nested; a warning names those that mean nothing here.

    Raises:
        UserError: a key that is none of theirs, or a section that is none.
    """
    found: dict[str, Any] = {}
    left_out = []
    for section in (BESIDE, POLICY, LEARN):
        for key, value in _rlpt_keys(raw, section, source).items():
            name = f"{section}.{key}".lstrip(".")
            if key in RLPT_NOTHING[section]:
                left_out.append(name)
            elif (ours := RLPT[section].get(key)) is None:
                allowed = [f"{section}.{k}".lstrip(".") for k in (*RLPT[section], *RLPT_NOTHING[section])]
                raise unknown(f"{source}: key", name, allowed)
            else:
                outer, _, inner = ours.partition(".")
                found.setdefault(outer, {})[inner] = value  # a key of no section under the empty name
    if left_out:
        warnings.warn(f"{source}: left out, as they mean nothing here: {', '.join(left_out)}", stacklevel=3)
    return {key: value.get("", value) for key, value in found.items()}


def _rlpt_keys(raw: Mapping[str, Any], section: str, source: str) -> Mapping[str, Any]:
    """Return the keys of a section; for the empty name those beside the sections."""
    if section == BESIDE:
        return {key: value for key, value in raw.items() if key not in (POLICY, LEARN)}
    content = raw.get(section) or {}
    if not isinstance(content, Mapping):
        raise UserError(f"{source}: {section} = {content!r}: expected a section of `key: value` lines")
    return content
