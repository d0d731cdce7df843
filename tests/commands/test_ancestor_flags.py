"""Flags of Isaac Lab, rsl_rl, Isaac Gym and BayesSimIG: each has its meaning here, or one clear word."""

from typing import Any

import pytest

from bayessim_mjx import cli, main, play, train
from bayessim_mjx.errors import UserError
from tests.commands.toy_runs import error_of

THEIRS = (
    "--episode_length --sim_device --rl_device --pipeline --graphics_device_id --flex --physx --num_threads --subscenes"
    " --slices --resume --test --play --randomize --torch_deterministic --experiment --metadata --checkpoint --horovod"
    " --steps_num --minibatch_size --task_type --agent --distributed --experiment_name --run_name --load_run --logger"
    " --log_project_name --export_io_descriptors --real-time --algorithm --ml_framework --sigma --track"
    " --wandb-project-name --wandb-entity --wandb-name --log_interval --keep_all_info --disable_fabric --enable_cameras"
    " --use_pretrained_checkpoint --use_last_checkpoint --headless --task --seed --num_envs --max_iterations --logdir"
    " --cfg_env --cfg_train --video --video_length --video_interval --rl_library --viz --frontend --train_env_cfg"
    " --ray-proc-id --set --xr --experience --rendering_mode --kit_args --livestream --cpu --multi_gpu --deterministic"
    " --device --compute_device_id --use_gpu --use_gpu_pipeline --nographics --force_render --wandb_activate --keyboard"
    " --capture_video"
)


def config_of(*argv: str) -> Any:
    return cli.config_of(cli.Parser("main", "").parse(["--task", "Pendulum", *argv]))


@pytest.mark.parametrize("module", [main, train, play])
def test_none_of_them_is_an_unknown_flag(module: Any, capsys: pytest.CaptureFixture) -> None:
    parser = module._parser()
    for flag in THEIRS.split():
        if flag not in parser._option_string_actions:
            line = error_of(capsys, module.main, flag)
            assert line.startswith(f"error: {flag}: ") and "unknown" not in line, line


def test_what_means_the_same_is_taken() -> None:
    assert config_of("--episode_length", "77").env.episodeLength == 77
    assert config_of("--episode_length", "0").env.episodeLength == config_of().env.episodeLength
    assert config_of("--sim_device", "cpu", "--rl_device", "cpu").device == "cpu"
    assert config_of("--device", "cpu").device == "cpu" and config_of().device == "auto"
    assert config_of("--run_name", "trial").name == "trial"
    assert config_of("--logger", "wandb").monitor.writers == ("wandb",)
    assert config_of("--logger", "tensorboard", "monitor.writers=[csv]").monitor.writers == ("csv",)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--sim_device", "cuda:0", "--rl_device", "cpu"], ["--sim_device cuda:0 and --rl_device cpu", "one setting"]),
        (["--device", "cpu", "--rl_device", "cuda:0"], ["--device cpu and --rl_device cuda:0"]),
        (["--name", "a", "--run_name", "b"], ["--name a and --run_name b"]),
        (["--logger", "neptune"], ["--logger", "'neptune'", "tensorboard, jsonl, csv, wandb"]),
        (["--episode_length", "-1"], ["env.episodeLength = -1", "--episode_length"]),
        (["--test"], ["bayessim-mjx play --checkpoint RUN"]),
        (["--distributed"], ["--devices all"]),
        (["--load_run", "x"], ["--resume RUN", "--checkpoint RUN"]),
        (["task=Ant"], ["override 'task=Ant': this is a flag: --task Ant"]),  # as IsaacGymEnvs has them
        (["headless=True"], ["this is a flag: --headless"]),
        (["test=True"], ["bayessim-mjx play --checkpoint RUN"]),
        (["--task", "Isaac-Ant-Direct-v0"], ["'Isaac-Ant-Direct-v0' is unknown. Here it is called Ant"]),
        (["--wandb-entity=me"], ["--wandb-entity: use --logger wandb"]),
    ],
)
def test_what_does_not_is_said(argv: list[str], words: list[str], capsys: pytest.CaptureFixture) -> None:
    line = error_of(capsys, train.main, "--task", "Pendulum", *argv)
    assert all(word in line for word in words), line


def test_a_resumed_run_may_move_to_another_device_by_any_name() -> None:
    args = cli.Parser("main", "", resume=True).parse(["--resume", "RUN", "--sim_device", "cpu"])
    assert cli.resumed_config(args, config_of()).device == "cpu"
    args = cli.Parser("main", "", resume=True).parse(["--resume", "RUN", "--run_name", "b"])
    with pytest.raises(UserError, match="--resume goes on with the run's own settings, which --name would change"):
        cli.resumed_config(args, config_of())
    with pytest.raises(UserError, match="--run_name: play has no use for it"):
        play._parser().parse(["--run_name", "b"])
