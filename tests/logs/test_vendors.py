"""Recordings of vendors: Unitree, Franka, UR and PACE, and ros2_control's further messages."""

import io
import json
import pickle
import sys
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log, read_logs
from bayessim_mjx.logs.importers import pace
from bayessim_mjx.logs.importers.ros import Choice, Message, recording
from bayessim_mjx.logs.vendors import motors
from tests.logs.importing import START, call, error, named, stamp

STEP = 10_000_000  # ns
LEG = tuple(f"FL_{part}_joint" for part in ("hip", "thigh", "calf"))
T = 0.01 * np.arange(100)
ANGLES = np.stack([0.3 * np.sin(3 * T), 0.5 + 0.4 * np.sin(2 * T), -1.2 + 0.3 * np.cos(4 * T)], 1)
SPEEDS = np.stack([0.9 * np.cos(3 * T), 0.8 * np.cos(2 * T), -1.2 * np.sin(4 * T)], 1)
TARGETS = ANGLES + 0.05 * np.cos(3 * T)[:, None]


def chain(joints: tuple[str, ...], servo: bool = False) -> str:
    tag = "position kp='40'" if servo else "motor"
    body = "".join(
        f'<body pos="0 0 -.1"><joint name="{j}" axis="0 1 0"/><geom size=".02" mass=".3" pos="0 0 -.1"/>'
        for j in joints
    )
    drives = "".join(f'<{tag} name="{j.removesuffix("_joint")}" joint="{j}"/>' for j in joints)
    ends = "</body>" * len(joints)
    return f"<mujoco><worldbody>{body}{ends}</worldbody><actuator>{drives}</actuator></mujoco>"


def model(folder: Path, joints: tuple[str, ...] = LEG, servo: bool = False) -> Path:
    (folder / "robot.xml").write_text(chain(joints, servo))
    return folder / "robot.xml"


def logs(folder: Path, xml: Path) -> list[Log]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_logs(folder, mujoco.MjModel.from_xml_path(str(xml)))


def motor(k: int, i: int, own: int | None) -> dict[str, float]:
    q = 9.0 if own is None else ANGLES[k, own]
    return {"mode": 1, "q": q, "dq": 0.0 if own is None else SPEEDS[k, own], "tau_est": 0.1 * k + i}


def order(k: int, i: int, own: int | None, **more: float) -> dict[str, float]:
    q = 9.0 if own is None else TARGETS[k, own]
    return {"mode": 1, "q": q, "dq": 0.0, "tau": 0.0, "kp": 20.0, "kd": 0.5, **more}


def low(k: int, make: Callable[..., dict], **more: float) -> list[dict]:
    """Twelve motors, those of the left front leg are 3 to 5."""
    return [make(k, i, i - 3 if 3 <= i < 6 else None, **more) for i in range(12)]


def bag(**more: float) -> list[Message]:
    out = []
    for k in range(100):
        at = START + STEP * k
        out.append(Message("/lowstate", "LowState", at, named(motor_state=[named(**m) for m in low(k, motor)])))
        out.append(Message("/lowcmd", "LowCmd", at, named(motor_cmd=[named(**m) for m in low(k, order, **more)])))
    return out


def test_unitrees_motors_are_joints_by_their_names_and_a_law_that_stays_is_declared() -> None:
    found = recording("run", bag(), Choice(hinges=LEG))
    np.testing.assert_allclose(found.positions[LEG[1]].values, ANGLES[:, 1])
    np.testing.assert_allclose(found.commands[LEG[2]].values, TARGETS[:, 2])
    np.testing.assert_allclose(found.efforts[LEG[0]].values, 0.1 * np.arange(100) + 3)
    assert found.laws[LEG[0]] == {"law": "position", "kp": 20.0, "kd": 0.5}
    by_hand = recording("run", bag(), Choice(joints=("a", "b", "c", *LEG)))
    np.testing.assert_allclose(by_hand.positions[LEG[1]].values, ANGLES[:, 1])


def test_unitrees_torques_are_the_commands_or_the_sum_of_the_law_is() -> None:
    found = recording("run", bag(kp=0.0, kd=0.0, tau=1.5), Choice(hinges=LEG))
    assert set(found.commands[LEG[0]].values) == {1.5} and not found.laws
    found = recording("run", bag(tau=1.5, dq=0.2), Choice(hinges=LEG))
    np.testing.assert_allclose(found.commands[LEG[1]].values, TARGETS[:, 1] + (1.5 + 0.5 * 0.2) / 20, atol=1e-9)
    assert found.laws[LEG[1]]["kp"] == 20.0
    varied = [m for i, m in enumerate(bag(tau=1.5)) if i > 1] + bag(tau=1.5, kp=10.0)[:2]
    found = recording("run", varied, Choice(hinges=LEG))
    law = 20 * (TARGETS - ANGLES) - 0.5 * SPEEDS
    np.testing.assert_allclose(found.commands[LEG[1]].sorted().values[1:], law[1:, 1] + 1.5, atol=1e-9)
    assert not found.laws and any("is summed of" in note for note in found.notes)
    found = recording("run", bag(tau=1.5), Choice(hinges=LEG, targets=True))
    np.testing.assert_allclose(found.commands[LEG[1]].values, TARGETS[:, 1])


def test_numbers_of_motors_that_nobody_explains_are_refused() -> None:
    with pytest.raises(UserError, match="motors are numbered; allowed: --model FILE, or --joints"):
        recording("run", bag(), Choice())
    with pytest.raises(UserError, match="none of Go2.*`--joints`"):
        recording("run", bag(), Choice(hinges=("elbow",)))
    with pytest.raises(UserError, match="those of G1 or H1-2 or H1"):
        motors("Unitree", ["left_knee_joint"])
    assert motors("Unitree", list(LEG)) == {3: LEG[0], 4: LEG[1], 5: LEG[2]}


def rows_of(table: Mapping[str, np.ndarray], path: Path, sep: str = ",") -> Path:
    path.parent.mkdir(exist_ok=True)
    lines = zip(*([f"{x:.9g}" for x in column] for column in table.values()), strict=True)
    path.write_text("\n".join([sep.join(table), *(sep.join(line) for line in lines)]) + "\n")
    return path


def check(capsys: pytest.CaptureFixture, folder: Path, xml: Path) -> tuple[int, str]:
    code = import_logs.main(["check", str(folder), "--model", str(xml)])
    return code, capsys.readouterr().out


def test_unitrees_json_lines_are_mapped_by_motors(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    xml, folder = model(tmp_path), tmp_path / "logs"
    folder.mkdir()
    rows = [{"tick": 10 * k, "motor_state": low(k, motor), "motor_cmd": low(k, order)} for k in range(100)]
    (folder / "run.jsonl").write_text("\n".join(map(json.dumps, rows)))
    code, out = check(capsys, folder, xml)
    assert "missing: " not in out and "numbers of Unitree are joints: 3 FL_hip_joint" in out, out
    (log,) = logs(folder, xml)
    np.testing.assert_allclose(log.time, T, atol=1e-9)
    np.testing.assert_allclose(np.c_[log.qpos, log.ctrl], np.c_[ANGLES, TARGETS])
    assert log.metadata["controller"]["FL_calf"] == {"law": "position", "kp": 20.0, "kd": 0.5}


def test_frankas_csv_is_in_ms_and_its_torques_are_without_gravity(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    joints = tuple(f"panda_joint{i}" for i in range(1, 8))
    xml = model(tmp_path, joints)
    angles, torques = np.sin(np.outer(T, np.arange(1, 8))), np.cos(np.outer(T, np.arange(1, 8)))
    table = {"time": 10 + 1e3 * T, " success_rate": np.ones(100)}
    table |= {f" state.q[{i}]": angles[:, i] for i in range(7)} | {f" cmd.q_d[{i}]": 0 * T for i in range(7)}
    table |= {f" cmd.tau_J_d[{i}]": torques[:, i] for i in range(7)}
    rows_of(table, tmp_path / "logs" / "run.csv")
    code, out = check(capsys, tmp_path / "logs", xml)
    assert "missing: " not in out and "without the gravity" in out, out
    (log,) = logs(tmp_path / "logs", xml)
    np.testing.assert_allclose(np.c_[log.time - 0.01, log.qpos, log.ctrl], np.c_[T, angles, torques], atol=1e-8)


def test_urs_csv_has_targets_for_servos_and_no_torque(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    joints = tuple(f"{n}_joint" for n in names)
    angles = 0.3 * np.sin(np.outer(T, np.arange(1, 7)))
    table = {"timestamp": 5.0 + T, **{f"target_q_{i}": angles[:, i] + 0.01 for i in range(6)},
             **{f"actual_q_{i}": angles[:, i] for i in range(6)}}  # fmt: skip
    rows_of(table, tmp_path / "logs" / "run.csv", " ")
    xml = model(tmp_path, joints, servo=True)
    code, out = check(capsys, tmp_path / "logs", xml)
    assert "missing: " not in out, out
    (log,) = logs(tmp_path / "logs", xml)
    np.testing.assert_allclose(np.c_[log.qpos, log.ctrl], np.c_[angles, angles + 0.01], atol=1e-8)
    (tmp_path / "logs" / "map.yaml").unlink()
    code, out = check(capsys, tmp_path / "logs", model(tmp_path, joints))
    assert code == 2 and "target_q_0 is a target" in out and "law: position" in out, out


def array_bag(swapped: bool, torque: bool) -> list[Message]:
    out = []
    for k in range(600):
        at, t = START + STEP * k, 0.01 * k
        q = np.array([0.3 * np.sin(3 * t), 0.5 + 0.4 * np.sin(2 * t + 1), -1.2 + 0.3 * np.cos(4.3 * t)])
        body = named(header=stamp(at), name=list(LEG), position=list(q), velocity=[], effort=[])
        out.append(Message("/joint_states", "JointState", at, body))
        sent = -4 * q + 0.5 * np.sin(5 * t) if torque else q + 0.05
        sent = sent[[1, 0, 2]] if swapped else sent
        out.append(Message("/u", "Float64MultiArray", at, named(data=list(sent), layout=named(dim=[]))))
    return out


@pytest.mark.parametrize("torque", [False, True])
def test_an_order_that_fits_far_better_is_reported(torque: bool) -> None:
    choice = Choice(commands={"/u": LEG})
    notes = recording("run", array_bag(True, torque), choice).notes
    order = ",".join(LEG[i] for i in (1, 0, 2))
    assert any(f"--commands /u={order}" in note for note in notes), notes
    assert not any("far better" in note for note in recording("run", array_bag(False, torque), choice).notes)
    with pytest.raises(UserError, match=r"which of its 3 values is whose; allowed: --commands /u=A,B,C"):
        recording("run", array_bag(False, torque), Choice())


def torch_file(path: Path, content: Mapping[str, Any]) -> Path:
    """Write a file as `torch.save` does, of arrays of float64."""
    utils, torch = ModuleType("torch._utils"), ModuleType("torch")
    exec("def _rebuild_tensor_v2(): ...\n", utils.__dict__)  # its name is what is pickled
    exec("class DoubleStorage: ...\n", torch.__dict__)
    storages: list[np.ndarray] = []

    class Tensor:
        def __init__(self, values: np.ndarray) -> None:
            storages.append(np.ascontiguousarray(values, float))
            self.key, self.shape = str(len(storages) - 1), values.shape

        def __reduce__(self) -> Any:
            strides = tuple(int(np.prod(self.shape[i + 1 :])) for i in range(len(self.shape)))
            return utils._rebuild_tensor_v2, (Storage(self.key), 0, tuple(self.shape), strides, False, {})

    class Storage:
        def __init__(self, key: str) -> None:
            self.key = key

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return ("storage", torch.DoubleStorage, obj.key, "cpu", 1) if isinstance(obj, Storage) else None

    raw = io.BytesIO()
    modules = {"torch": torch, "torch._utils": utils}
    sys.modules.update(modules)
    try:
        Pickler(raw, 2).dump({k: Tensor(v) if isinstance(v, np.ndarray) else v for k, v in content.items()})
    finally:
        for name in modules:
            del sys.modules[name]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("chirp/data.pkl", raw.getvalue())
        for i, storage in enumerate(storages):
            archive.writestr(f"chirp/data/{i}", storage.tobytes())
    return path


CHIRP = {"time": T, "dof_pos": ANGLES, "des_dof_pos": TARGETS, "des_dof_vel": np.full((100, 3), 2.0),
         "kp": np.full(3, 20.0), "kd": np.full(3, 0.5)}  # fmt: skip


def test_paces_chirps_are_logs_with_their_law(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    xml, path = model(tmp_path), torch_file(tmp_path / "chirp.pt", CHIRP)
    start = ("from-pace", path, "--model", xml, "--out")
    assert "--joints with 3 names" in error(capsys, *start, tmp_path / "a")
    out = call(capsys, *start, tmp_path / "logs", "--joints", *LEG)
    assert "chirp.yaml declares the position law" in out
    (log,) = logs(tmp_path / "logs", xml)
    np.testing.assert_allclose(
        np.c_[log.time, log.qpos, log.ctrl], np.c_[T, ANGLES, TARGETS + 2.0 * 0.5 / 20], atol=1e-9
    )
    assert log.metadata["controller"]["FL_hip"] == {"law": "position", "kp": 20.0, "kd": 0.5}
    call(capsys, "from-pace", path, "--model", model(tmp_path, servo=True), "--out", tmp_path / "b", "--joints", *LEG)
    assert not (tmp_path / "b" / "chirp.yaml").exists()  # the model's own servo is the law


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"cbuiltins\neval\n(Vprint('run')\ntR.", "builtins.eval in a file that should hold arrays only"),
        (b"cnumpy.testing\nmeasure\n(Vprint('run')\ntR.", "numpy.testing.measure in a file"),
        (pickle.dumps(np.ones(3), 2), "ndarray in place of a mapping"),
        (b"garbage", "UnpicklingError"),
    ],
)
def test_a_pt_file_runs_nothing(tmp_path: Path, content: bytes, why: str, capsys: pytest.CaptureFixture) -> None:
    with zipfile.ZipFile(tmp_path / "bad.pt", "w") as archive:
        archive.writestr("x/data.pkl", content)
    with pytest.raises(UserError, match=why):
        pace.arrays(tmp_path / "bad.pt")
    (tmp_path / "old.pt").write_bytes(content)
    with pytest.raises(UserError, match="not readable.*PyTorch 1.6"):
        pace.arrays(tmp_path / "old.pt")
    assert not capsys.readouterr().out


def test_a_tensor_does_not_reach_beyond_its_storage() -> None:
    with pytest.raises(pickle.UnpicklingError, match="beyond its storage"):
        pace._tensor(np.arange(4.0), 0, (3,), (2,))
    np.testing.assert_array_equal(pace._tensor(np.arange(6.0), 1, (2, 2), (2, 1)), [[1, 2], [3, 4]])
