"""The commands, called in this process: bad input is one line and exit code 2, and help needs nothing but flags."""

import ast
import errno
import os
import re
import runpy
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import mujoco
import pytest

import bayessim_mjx
from bayessim_mjx import cli, diagnose, main, play, train
from bayessim_mjx.cli.commands import module_of
from bayessim_mjx.errors import UserError
from tests.commands.toy_runs import SMALL, error_of


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "robot.xml"], ["'robot.xml': a model's file is no task", "diagnose --model robot.xml"]),
        (["--task", "Pendulm"], ["'Pendulm'", "Did you mean Pendulum", "Allowed: Ant, "]),
        (["--tsk", "Pendulum"], ["'--tsk'", "Did you mean --task"]),
        (["--task", "Pendulum", "--num_envs", "many"], ["--num_envs", "'many'"]),
        (["--task", "Pendulum", "--num_envs", "-1"], ["env.numEnvs = -1", "--num_envs", "at least 1"]),
        (["--task", "Pendulum", "--task"], ["--task", "expected one argument"]),
        (["--task", "Pendulum", "word"], ["'word'", "section.key=value"]),
        (["--task", "Pendulum", "bayessim.component=5"], ["bayessim.component", "Did you mean bayessim.components"]),
        (["--task", "Pendulum", "--device", "tpu:7"], ["device = 'tpu:7'", "available: cpu:0"]),
        (["--task", "Pendulum", "--device", "abacus"], ["device = 'abacus'", "cuda:0"]),
        (["--task", "Pendulum", "--device", "auto:1"], ["device = 'auto:1'", "expected auto, cpu, gpu"]),
        (["--task", "Pendulum", "--cfg_env", "nowhere.yaml"], ["nowhere.yaml", "cannot be read"]),
        (["--task", "Pendulum", "--name", "../up"], ["name = '../up'"]),
        (["--resume", "nowhere"], ["nowhere: not a run folder"]),
        (["--task", "Pendulum", "--checkpoint", "nowhere"], ["--checkpoint nowhere: no such folder"]),
        (["--task", "Pendulum", "--use_last_checkpoint"], ["no run of 'Pendulum' with a checkpoint"]),
        (["--task", "Pendulum", "--use_last_checkpoint", "--checkpoint", "best"], ["give one of them"]),
        (["--task", "Pendulum", "--num_envs", "\u0663"], ["--num_envs", "'\u0663'"]),
        (["--task", "Pendulum", "--seed", "9" * 20], ["seed = 99999999999999999999", "at most 4294967295"]),
        (["--task", "Pendulum", "--num_envs", str(10**13)], ["env.numEnvs = 10000000000000", "--num_envs", "at most"]),
        (["--task", "Pendulum", "--num_envs", "4", "ppo.num_envs=8"], ["--num_envs", "num_envs=8", "one setting"]),
        (["--seed", "1"], ["no task", "--list_tasks"]),
    ],
)
@pytest.mark.parametrize("command", [main.main, train.main])
def test_bad_input_is_one_line(command: Any, argv: list[str], words: list[str], capsys: Any, toy: None) -> None:
    line = error_of(capsys, command, *argv)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env.realParams.means=[[1.0, 5.0]]", ["env.realParams.means", "length", "5", "[0.01, 2]"]),
        ("env.realParams.means=[[1.0, 0.5, 3.0]]", ["env.realParams.means", "3"]),
        ("env.realParams.means=[{mass: 1.0}]", ["mass"]),
        ("real.logs=[empty]", ["empty"]),
    ],
)
def test_bad_real_side_is_one_line(override: str, words: list[str], capsys: Any, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    line = error_of(capsys, main.main, "--task", "Pendulum", override)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("command", "override", "words"),
    [
        (main.main, "ppo.teacher=/nope", ["ppo.teacher = '/nope'", "train --distil"]),
        (train.main, "bayessim.components=5", ["bayessim.components: train has no use for it"]),
        (train.main, "real.logs=[a]", ["real.logs: train has no use for it"]),
    ],
)
def test_settings_of_another_command_are_refused(command: Any, override: str, words: list[str], capsys: Any) -> None:
    line = error_of(capsys, command, "--task", "Pendulum", override)
    assert all(word in line for word in words), line


def test_what_means_nothing_here_is_one_note(capsys: Any, tmp_path: Path, toy: None) -> None:
    (tmp_path / "f.yaml").write_text("sim: {substeps: 2}\nenv: {envSpacing: 2}\n")
    assert train.main(["--task", "Pendulum", *SMALL, "--cfg_env", "f.yaml", "--max_iterations", "0"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "mean nothing" in line]
    assert line == "note: f.yaml: left out, as they mean nothing here: sim, env.envSpacing"


def test_help_and_task_list_need_no_task(capsys: pytest.CaptureFixture) -> None:
    assert main.main(["--list_tasks"]) == 0
    assert {"Pendulum", "Cartpole", "Ant"} <= set(capsys.readouterr().out.split())


def shown(capsys: pytest.CaptureFixture, *argv: str) -> str:
    """What a command prints that has to succeed."""
    assert main.main(list(argv)) == 0
    return capsys.readouterr().out


def test_the_list_of_commands_has_groups_and_a_line_for_each(capsys: pytest.CaptureFixture) -> None:
    text = shown(capsys, "--help")
    assert text.startswith("usage: bayessim-mjx COMMAND [options]\n")
    assert shown(capsys) == shown(capsys, "help") == shown(capsys, "-h") == text
    assert shown(capsys, "-h", "play") == shown(capsys, "help", "play") != text
    lines = text.splitlines()
    for name, command in cli.COMMANDS.items():
        heading = lines.index(f"{command.group}:")
        section = lines[heading + 1 : lines.index("", heading)]
        assert [line.split()[1:] for line in section if line.split()[0] == name] == [command.about.split()]


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_help_has_one_spelling_groups_defaults_and_examples(name: str, capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = shown(capsys, name, "--help")
    assert text.startswith(f"usage: bayessim-mjx {name} ") and max(map(len, text.splitlines())) <= 80
    assert shown(capsys, name.replace("-", "_"), "--help") == shown(capsys, "help", name) == text
    assert "bayessim_mjx." not in text
    lines = text[text.index("\nexamples:\n") :].splitlines()
    assert len([line for line in lines if line.startswith(f"  bayessim-mjx {name} ")]) == 2
    flags = [line for line in text.splitlines() if line.startswith("  -")]
    rows = text.splitlines()
    assert all(len(f.split()) > 2 or rows[rows.index(f) + 1].startswith(" " * 8) for f in flags), flags
    if name not in ("help", "completion", "logs", "policy"):  # these have parts with flags of their own
        headings = [line for line in rows if line.endswith(":") and not line.startswith((" ", "usage", "options"))]
        assert len(headings) >= 3 and "(default: " in text, headings


def test_a_module_shows_the_help_of_its_command() -> None:
    for module, name in (("main", "main"), ("gap_loop", "gap-loop"), ("blind_check", "blind"), ("import_logs", "logs")):
        call = [sys.executable, "-m", f"bayessim_mjx.{module}", "--help"]
        text = subprocess.run(call, check=True, capture_output=True, text=True).stdout
        assert text.startswith(f"usage: bayessim-mjx {name} ")


def test_the_examples_of_the_helps_are_accepted(monkeypatch: Any) -> None:
    """By the parser; those that need nothing of the user's also by the settings."""
    for name, command in cli.COMMANDS.items():
        own = {"help": main._help_parser, "completion": main._completion_parser, "main": main._parser}
        parser = own.get(name) or import_module(f"bayessim_mjx.{module_of(name)}")._parser
        for example in command.examples:
            words = shlex.split(example)
            args = parser().parse(words) if isinstance(parser(), cli.Parser) else parser().parse_args(words)
            if "--task" in words and isinstance(parser(), cli.Parser) and "LOGS" not in example:
                assert cli.config_of(args).task == args.task


def test_messages_spell_commands_as_the_helps_do() -> None:
    """`python -m` and names of modules are for programs; a person types `bayessim-mjx COMMAND`."""
    modules = "|".join(module_of(name) for name in cli.COMMANDS if name not in ("help", "completion"))
    package = Path(bayessim_mjx.__file__).parent
    found = {
        file.relative_to(package).as_posix(): re.findall(rf"python -m bayessim_mjx\.(?:{modules})\b", file.read_text())
        for file in [*package.rglob("*.py"), *package.rglob("*.json"), *package.rglob("*.j2")]
    }
    assert {name: calls for name, calls in found.items() if calls} == {"main.py": ["python -m bayessim_mjx.main"]}


def test_flags_and_settings_without_a_command_are_those_of_main(capsys: pytest.CaptureFixture) -> None:
    assert error_of(capsys, main.main, "--tsk", "Ant") == error_of(capsys, main.main, "main", "--tsk", "Ant")


def test_a_command_that_does_not_exist_is_one_line(capsys: pytest.CaptureFixture) -> None:
    line = error_of(capsys, main.main, "gap-lop", "--task", "Pendulum")
    assert "command 'gap-lop' is unknown. Did you mean gap-loop?" in line and "train, play" in line


def test_version(capsys: pytest.CaptureFixture) -> None:
    for command in (main.main, play.main, diagnose.main):
        assert command(["--version"]) == 0
        said = capsys.readouterr().out
        assert said.startswith(f"bayessim-mjx {bayessim_mjx.__version__} (python ")
        assert f"jax {jax.__version__}, mujoco {mujoco.__version__})" in said


def test_flags_are_read_before_jax_is_imported() -> None:
    slow = "{'jax', 'mujoco', 'numpy', 'rich', 'yaml'} & set(sys.modules)"
    for call in (["diagnose", "--help"], ["--version"], ["nothing"]):
        code = f"import sys; from bayessim_mjx.main import main; main({call}); assert not ({slow}), {slow}"
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_every_ancestor_flag_is_known() -> None:
    flags = "--task --num_envs --seed --max_iterations --headless --video --video_length --video_interval --checkpoint"
    flags += " --use_last_checkpoint --logdir --cfg_env --cfg_train --device"
    for prog in ("main", "train", "play"):
        assert set(flags.split()) <= set(cli.Parser(prog, "")._option_string_actions)


def test_seed_minus_one_is_drawn_and_recorded() -> None:
    args = cli.Parser("main", "").parse(["--task", "pendulum", "--seed", "-1", "ppo.gamma=0.5"])
    config = cli.config_of(args)
    assert 0 <= config.seed < 10_000 and config.task == "Pendulum" and config.ppo.gamma == 0.5


def test_only_what_the_user_can_mend_is_one_line(capsys: pytest.CaptureFixture) -> None:
    """Exit codes: 2 for a user's error and for what the system refuses, 1 with the traceback for a bug."""

    def ends(error: BaseException) -> tuple[int, str]:
        def run(argv: Any) -> int:
            raise error

        return cli.command(run)([]), capsys.readouterr().err

    assert ends(UserError("x = 3:\nallowed: 4")) == (2, "error: x = 3: allowed: 4\n")
    assert ends(PermissionError(errno.EACCES, "Permission denied", "out")) == (
        2, f"error: [Errno {errno.EACCES}] Permission denied: 'out'\n",
    )  # fmt: skip
    assert ends(KeyboardInterrupt())[0] == 130 and ends(SystemExit(0)) == (0, "")
    for bug in (ValueError("math domain error"), FloatingPointError("x"), KeyError("k"), SystemExit("bye")):
        code, err = ends(bug)
        assert code == 1 and "Traceback" in err and "please report it" in err.splitlines()[-1]


def test_an_opengl_library_that_cannot_be_loaded_is_named_with_those_that_are_allowed() -> None:
    """MuJoCo fails when it is imported; a process of its own, as this one has imported it."""
    code = "import sys; from bayessim_mjx import cli; sys.exit(cli.command(lambda argv: __import__('mujoco'))([]))"
    bogus = os.environ | {"MUJOCO_GL": "bogus", "PYTHONPATH": str(Path(bayessim_mjx.__file__).parents[1])}
    ended = subprocess.run([sys.executable, "-c", code], env=bogus, capture_output=True, text=True)
    assert ended.returncode == 2 and ended.stderr.startswith("error: MUJOCO_GL=bogus: OpenGL cannot be loaded; allowed")
    assert "osmesa" in ended.stderr and ended.stderr.count("\n") == 1


def test_a_path_that_no_system_takes_is_one_line(capsys: pytest.CaptureFixture) -> None:
    xml = "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>"
    Path("arm.xml").write_text(xml + "<actuator><motor name='m' joint='j'/></actuator></mujoco>")
    line = error_of(capsys, diagnose.main, "--model", "arm.xml", "--data", "a" * 300)
    assert "a" * 300 in line and "too long" in line


@pytest.mark.parametrize("name", [p.name for p in sorted((Path(__file__).parents[2] / "examples").glob("*.py"))])
def test_examples_say_what_they_are(name: str, monkeypatch: Any, capsys: pytest.CaptureFixture) -> None:
    file = Path(__file__).parents[2] / "examples" / name
    monkeypatch.syspath_prepend(file.parent)
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(file), run_name="__main__")
    first = ast.get_docstring(ast.parse(file.read_text()))
    assert end.value.code in (None, 0) and first is not None
    assert first.split()[:6] == capsys.readouterr().out.partition("\n\n")[2].split()[:6]
