"""What a new user may get wrong, over all commands: exit code 2 and one line with the value, and what to do."""

import math
from pathlib import Path
from typing import Any

import pytest

from bayessim_mjx import cli, main
from bayessim_mjx.errors import UserError
from tests.commands.toy_runs import error_of

ARM = """<mujoco><worldbody><body name="link"><joint name="hinge"/><geom size=".1"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


@pytest.fixture(autouse=True)
def files(quiet: None) -> None:
    """A robot, logs of it, and files and folders that are none."""
    Path("arm.xml").write_text(ARM)
    Path("still.xml").write_text("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
    Path("broken.xml").write_text("<mujoco>")
    Path("note.txt").write_text("a note")
    Path("bad.yaml").write_text("ppo: [")
    Path("slip.yaml").write_text("bayessim: {component: 5}")
    for name in ("logs", "empty", "letters", "foreign"):
        Path(name).mkdir()
    rows = [f"{0.01 * i:.2f},{math.sin(0.03 * i):.4f},{0.1 * math.sin(0.02 * i):.5f}" for i in range(400)]
    Path("logs/a.csv").write_text("\n".join(["time,ctrl:motor,qpos:hinge", *rows]))
    Path("letters/a.csv").write_text("time,ctrl:motor,qpos:hinge\n0,0,0\n0.01,1,a\n")
    Path("foreign/a.csv").write_text("time,foo\n0,0\n0.01,1\n")


DIAGNOSE = "diagnose --model arm.xml --data logs"
WRONG = {
    "diagnos --model arm.xml": "command 'diagnos' is unknown. Did you mean diagnose?",
    "help nothing": "command 'nothing' is unknown. Allowed: main",
    "diagnose --data logs": "give one of --task NAME and --model FILE",
    "diagnose --model arm.xml": "--data is missing: give files or folders of logs",
    "diagnose --model none.xml --data logs": "--model none.xml: no such file",
    "diagnose --model broken.xml --data logs": "broken.xml: MuJoCo cannot load it",
    "diagnose --model note.txt --data logs": "note.txt: MuJoCo cannot load it",
    "diagnose --model still.xml --data logs": "still.xml: the model has no joint",
    "diagnose --model arm.xml --data none": "none: no such file or folder; allowed: a folder of logs",
    "diagnose --model arm.xml --data empty": "empty: no log matches '*'; it holds nothing; allowed: CSV",
    "diagnose --model arm.xml --data letters": "letters/a.csv: line 3, column 'qpos:hinge': 'a' is not a number",
    "diagnose --model arm.xml --data foreign": "foreign/a.csv: no column qpos:<joint>",
    f"{DIAGNOSE} --dta x": "flag '--dta' is unknown. Did you mean --data",
    f"{DIAGNOSE} -x": "flag '-x' is unknown. Allowed: the flags that bayessim-mjx diagnose --help lists",
    f"{DIAGNOSE} --effects coulomb": "--effects coulomb: no effect 'coulomb'; did you mean coulomb_friction?",
    f"{DIAGNOSE} --effects ,": "--effects ',': give names separated by commas, path.py:Class, or all",
    f"{DIAGNOSE} --effects none.py:X": "--effects none.py:X: effect none.py:X: no file none.py",
    f"{DIAGNOSE} --out note.txt": "--out note.txt: there is a file of that name; give a folder",
    f"{DIAGNOSE} --out note.txt/x": "note.txt is a file; give a folder",
    f"{DIAGNOSE} --map none.yaml": "none.yaml: cannot be read: No such file or directory",
    f"{DIAGNOSE} --map bad.yaml": "bad.yaml, line 1: not valid YAML",
    f"{DIAGNOSE} --parameters slip.yaml": "slip.yaml: no parameters: expected task.randomization_params",
    f"{DIAGNOSE} --tolerance elbow=1deg": "--tolerance elbow=1deg: no joint 'elbow'; there are: hinge",
    f"{DIAGNOSE} --accuracy weight=5%": "--accuracy weight=5%: no known parameter 'weight'; there are: mass",
    f"{DIAGNOSE} --payload heavy": "--payload heavy: 'heavy' is no number; allowed: a mass above 0 in kg",
    f"{DIAGNOSE} --blind empty": "--blind empty: no blind.json there; give the --out folder",
    f"{DIAGNOSE} --seed 1.5": "--seed: invalid int value: '1.5'; allowed: a whole number",
    f"{DIAGNOSE} --minutes -3": "--minutes: '-3': allowed: minutes, more than 0",
    "main --seed 1": "no task: give --task NAME (--list_tasks shows the names)",
    "train --task Pendulum --gamma 0.9": "Did you mean the setting ppo.gamma=VALUE, without dashes?",
    "main --task Pendlum": "--task 'Pendlum' is unknown. Did you mean Pendulum",
    "main --task Pendulum bayessim.component=5": "Allowed: those that `bayessim-mjx help settings bayessim` prints",
    "main --task Pendulum --cfg_env slip.yaml": "slip.yaml: key 'bayessim.component' is unknown",
    "main --task Pendulum --cfg_env bad.yaml": "bad.yaml, line 1: not valid YAML",
    "main --task Pendulum --cfg_env empty": "empty: cannot be read: not a file",
    "main --task Pendulum ppo.gamma=2": "ppo.gamma = 2.0 (override 'ppo.gamma=2'): must be at most 1",
    "main --task Pendulum ppo.gamma=abc": "ppo.gamma = 'abc' (override 'ppo.gamma=abc'): expected a number",
    "main --task Pendulum --logdir note.txt": "--logdir note.txt: there is a file of that name; give a folder",
    "main --task Pendulum effects=none.yaml": "effects = 'none.yaml' (override 'effects=none.yaml'): no such file",
    "main --task Pendulum train": "'train' is a command of its own: bayessim-mjx train",
    "main --task brax": "--task 'brax' is unknown",
    "main --resume empty": "--resume empty: not a run folder (no run.json in it); give the folder",
    "train --task Ant --agent tf": "--agent 'tf' is unknown. Allowed: own, sb3, rsl_rl, skrl",
    "train --task Ant --domain none": "--domain none: allowed are nominal, prior, the folder of a run",
    "train --task Ant --checkpoint empty": "--checkpoint empty: neither a run nor a checkpoint",
    "train --task Pendulum bayessim.components=3": "bayessim.components: train has no use for it; leave it out",
    "train --task Pendulum --logdir note.txt/x": "--logdir note.txt/x: ",
    "play": "--checkpoint best: give --task NAME, or the path of a run",
    "play --task Pendulum": "no run of 'Pendulum' with a checkpoint under logs/Pendulum",
    "play --checkpoint empty": "--checkpoint empty: neither a run nor a checkpoint",
    "play --task Ant --use_pretrained_checkpoint": "none comes for Ant; policies come for",
    "play --task Pendulum --use_pretrained_checkpoint --export a.txt": "--export a.txt: the file's name has to end",
    "play --task Pendulum --use_pretrained_checkpoint --export note.txt/a.onnx": "--export note.txt: there is a file",
    "play --task Pendulum --use_pretrained_checkpoint --hub note.txt": "--hub note.txt: there is a file of that name",
    "calibrate": "the following arguments are required: --run",
    "calibrate --run empty": "--run empty: not a run folder (no run.json in it); give the folder",
    "calibrate --run empty --pairs 3": "--pairs 3: at least 40",
    "gap-loop --task Pendulum": "--diagnosis is missing: give the folder that bayessim-mjx diagnose wrote",
    "gap-loop --task Pendulum --diagnosis empty --real logs": "--diagnosis empty: no diagnosis.json in it",
    "logs": "the following arguments are required: COMMAND",
    "logs chek logs": "COMMAND 'chek' is unknown. Did you mean check? Allowed: from-mcap,",
    "logs check none": "none: no such file or folder; allowed: a folder of logs",
    "logs check empty": "empty: no log; it holds nothing; allowed: files ending in .csv",
    "logs from-hdf5 none.h5 --out x": "none.h5: no such file or folder",
    "logs from-lerobot empty --out x": "allowed: a folder with meta/info.json",
    "logs from-mcap note.txt --out note.txt": "--out note.txt: there is a file of that name; give a folder",
    "logs from-mcap note.txt --out x --rename a": "--rename a; allowed: NAME_IN_THE_RECORDING=NAME_IN_THE_MODEL",
    "blind --model arm.xml --effects nothing": "--effects: 'nothing' is unknown",
    "blind --model arm.xml --accuracy 5": "--accuracy: '5': allowed: per cent from 0.1% to 30%",
    "blind --model arm.xml --out note.txt": "--out note.txt: there is a file of that name; give a folder",
    "implementations --task Nothing": "--task 'Nothing' is unknown. Allowed: Ant",
    "implementations --task Pendulum --seconds 0": "--seconds: '0': allowed: seconds, more than 0",
    "help settings pp": "section of settings 'pp' is unknown. Did you mean ppo? Allowed: env, bayessim,",
    "help settings ppo gamma": "help settings ppo gamma: give one section, such as ppo",
    "completion ksh": "shell 'ksh' is unknown. Did you mean zsh? Allowed: bash, zsh, fish",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_input_is_one_line_that_says_what_is_allowed(words: str, capsys: Any) -> None:
    assert main.main(words.split()) == 2
    *progress, line = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and WRONG[words] in line, line
    assert all(text.endswith(" s  checking the logs") for text in progress), progress
    assert not Path("diagnosis").exists() and not Path("x").exists()


def test_a_file_that_is_no_recording_is_one_line(capsys: Any) -> None:
    pytest.importorskip("mcap")
    line = error_of(capsys, main.main, "logs", "from-mcap", "note.txt", "--out", "x")
    assert "note.txt: not a readable MCAP file of ROS 2 messages" in line and "allowed: an .mcap file" in line


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(
    tmp_path: Path, monkeypatch: Any
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    cli.writable(tmp_path / "new" / "folder", "--out")
    assert not (tmp_path / "new").exists() and not list(tmp_path.glob(".bayessim_mjx_*"))
    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    with pytest.raises(UserError, match=r"--out .*folder: .* cannot be written \(Permission denied\); give another"):
        cli.writable(tmp_path / "new" / "folder", "--out")
