"""Flags of Isaac Lab, rsl_rl, Isaac Gym and BayesSimIG that are called otherwise here, or that nothing here needs."""

from bayessim_mjx.errors import UserError

SAME = {"--sim_device": "--device", "--rl_device": "--device", "--run_name": "--name"}  # names of one setting

_DEVICES = "--devices N or --devices all spreads the worlds over several devices"
_LOOK = "nothing is shown while it runs; --video films the policy, at the speed of the clock"
_ENGINE = "the physics is MuJoCo MJX's; --device says where it runs, env.impl=warp takes its Warp kernels"
_WANDB = "use --logger wandb; its own variables name project, entity and run: WANDB_PROJECT, WANDB_ENTITY, WANDB_NAME"
_PLAY = "use the command play: bayessim-mjx play --checkpoint RUN"

INSTEAD = {
    "--test": _PLAY,
    "--play": _PLAY,
    "--distributed": _DEVICES,
    "--multi_gpu": _DEVICES,
    "--horovod": _DEVICES,
    "--experiment_name": "runs lie in <logdir>/<Task>/; use --logdir DIR for another folder, --name for a run's name",
    "--experiment": "use --name NAME for a run's name, --logdir DIR for another folder",
    "--metadata": "run.json and params/ of the run folder hold it in any case",
    "--load_run": "use --resume RUN to go on with a run, --checkpoint RUN to start from its policy or to play it",
    "--use_pretrained_checkpoint": "play has it; use --checkpoint with the path of a run or checkpoint",
    "--export_io_descriptors": "play --export writes them into the ONNX file",
    "--real_time": _LOOK,
    "--viz": _LOOK,
    "--livestream": _LOOK,
    "--xr": _LOOK,
    "--experience": _LOOK,
    "--rendering_mode": _LOOK,
    "--force_render": _LOOK,
    "--keyboard": _LOOK,
    "--kit_args": _LOOK,
    "--nographics": _LOOK,
    "--graphics_device_id": _LOOK,
    "--capture_video": "use --video; play --video films a policy",
    "--enable_cameras": "videos need no such flag; --video films",
    "--disable_fabric": _ENGINE,
    "--pipeline": _ENGINE,
    "--physx": _ENGINE,
    "--flex": _ENGINE,
    "--num_threads": _ENGINE,
    "--subscenes": _ENGINE,
    "--slices": _ENGINE,
    "--frontend": _ENGINE,
    "--use_gpu": _ENGINE,
    "--use_gpu_pipeline": _ENGINE,
    "--cpu": "use --device cpu",
    "--compute_device_id": "use --device cuda:N",
    "--torch_deterministic": "a run on a CPU is repeatable bit for bit in any case",
    "--deterministic": "a run on a CPU is repeatable bit for bit in any case",
    "--model": "policies need a task: --task NAME or --task file.py:Class makes one of a model (docs/own_task.md)",
    "--randomize": "train has it; main always draws the physics, and play does by --physics",
    "--train_env_cfg": "use --checkpoint RUN: its task and settings are taken up; --cfg_env FILE for others",
    "--ray_proc_id": "leave it out: runs of one second have folders of their own",
    "--set": "give section.key=value without it, as in ppo.gamma=0.95",
    "--agent": "train has it; a checkpoint knows its own network",
    "--rl_library": "use train --agent sb3, rsl_rl or skrl",
    "--algorithm": "PPO is the one there is; train --agent takes another library's",
    "--ml_framework": "skrl's JAX agents are the ones that train --agent skrl takes",
    "--log_interval": "use ppo.log_interval=N, in PPO iterations",
    "--steps_num": "use ppo.num_steps=N",
    "--minibatch_size": "use ppo.num_minibatches=N, the number of them",
    "--sigma": "use ppo.init_std=X",
    "--task_type": "leave it out",
    "--keep_all_info": "leave it out",
    "--log_project_name": _WANDB,
    "--track": _WANDB,
    "--wandb_activate": _WANDB,
    "--wandb_project_name": _WANDB,
    "--wandb_entity": _WANDB,
    "--wandb_name": _WANDB,
}


def word(flag: str) -> str | None:
    """Explain a flag that another tool has; None where none has it."""
    return INSTEAD.get("--" + flag.removeprefix("--").replace("-", "_"))


def one_value(values: dict[str, str | None]) -> str | None:
    """Return the value of a setting that several flags name, {flag: value}; UserError where they differ."""
    given = [(flag, value) for flag, value in values.items() if value is not None]
    for flag, value in given[1:]:
        if value != given[0][1]:
            raise UserError(f"{given[0][0]} {given[0][1]} and {flag} {value} are one setting here; give one of them")
    return given[0][1] if given else None
