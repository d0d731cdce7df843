"""Keys of BayesSimIG's and Isaac Gym's task files that mean nothing here: they are named in one note, not refused.

Other unknown keys are refused as ever: they may be slips of the finger. What a task's own file lists is the task's.
"""

import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

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
