"""`bayessim-mjx completion SHELL`: bash is asked itself; the other scripts name what there is."""

import shutil
import subprocess
from pathlib import Path

import pytest

from bayessim_mjx import cli, main
from tests.commands.toy_runs import error_of

pytest.importorskip("shtab")


def script(shell: str, capsys: pytest.CaptureFixture) -> str:
    assert main.main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_flags_tasks_and_files(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "script").write_text(script("bash", capsys))
    (tmp_path / "robot.xml").touch()
    asked = {
        "gap": "gap-loop", "train --max": "--max_iterations", "train --task Cartp": "Cartpole", "pla": "play",
        "diagnose --model rob": "robot.xml", "completion fi": "fish", "logs from-h": "from-hdf5",
    }  # fmt: skip
    for words, answer in asked.items():
        given = words.split()
        code = f"source ./script; COMP_WORDS=(bayessim-mjx {words}); COMP_CWORD={len(given)}; COMPREPLY=(); "
        code += '_shtab_bayessim_mjx 2>/dev/null; echo "${COMPREPLY[@]}"'
        shown = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        assert answer in shown.split(), (words, shown)


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_are_told_of_every_command(shell: str, capsys: pytest.CaptureFixture) -> None:
    text = script(shell, capsys)
    assert all(name in text for name in cli.COMMANDS) and "max_iterations" in text


def test_another_shell_is_one_line(capsys: pytest.CaptureFixture) -> None:
    assert "'ksh'" in error_of(capsys, main.main, "completion", "ksh")
