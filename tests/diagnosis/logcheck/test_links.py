"""The channel split: each link of command -> effort -> motion -> measurement is judged alone, with known answers."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.logcheck.gate import check
from bayessim_mjx.diagnosis.logcheck.links import Link, links
from bayessim_mjx.logs import Log, read_logs
from tests.diagnosis.recordings import ARM, PENDULUM, record, sines

ROOT = Path(__file__).resolve().parents[3]
RAW = ROOT.parent / "shared" / "data" / "xl330_servo" / "raw"
KP, KD = 8.0, 0.3
SERVO = PENDULUM.replace("<motor", f'<position kp="{KP}" kv="{KD}"')


def split(log: Log, xml: str = PENDULUM) -> dict[tuple[str, str], Link]:
    model = mujoco.MjModel.from_xml_string(xml)
    return {(x.name, x.where): x for x in links(log, model, check([log], model, log.period).timing)}


@pytest.fixture(scope="module")
def servo() -> Log:
    """A servo that logs its own effort exactly."""
    log = record(SERVO, sines((0.8,)), qvel=True, sigma=0.0)
    effort = KP * (log.ctrl[:, 0] - log.qpos[:, 0]) - KD * log.qvel[:, 0]
    return dataclasses.replace(log, streams={"effort:motor": effort})


@pytest.mark.parametrize(("slope", "late"), [(1.0, 0.0), (0.7, 0.0), (1.0, 0.03), (2.0, -0.05)])
def test_slope_and_lag_are_recovered(slope: float, late: float) -> None:
    log = record(PENDULUM, sines((0.8,)), controller={"law": "direct", "scale": 1.0})
    effort = slope * np.interp(log.time - late, log.time, log.ctrl[:, 0])
    link = split(dataclasses.replace(log, streams={"effort:motor": effort}))["command -> effort", "motor"]
    assert link.slope == pytest.approx(slope, abs=2e-3) and link.lag == pytest.approx(late, abs=1e-3)
    assert link.correlation == pytest.approx(1.0, abs=1e-3) and link.sound is (slope == 1.0 and not late)
    noise = np.random.default_rng(0).standard_normal(len(log))
    link = split(dataclasses.replace(log, streams={"effort:motor": noise}))["command -> effort", "motor"]
    assert not link.sound and link.correlation < 0.5


def test_in_a_sound_chain_no_error_is_seen(servo: Log) -> None:
    found = split(servo, SERVO)
    assert [k[0] for k in found] == ["command -> effort", "effort -> motion", "motion -> measurement"]
    for link in found.values():
        assert link.tested and link.sound, link
        assert link.correlation > 0.99 and abs(link.lag) < 0.01 and "no error seen by this test" in link.text
        assert link.slope == pytest.approx(1.0, abs=0.05)


def test_a_declared_law_explains_the_effort(servo: Log) -> None:
    law = {"controller": {"law": "position", "kp": KP, "kd": KD, "limit": 1.0, "scale": 0.5}}
    effort = np.clip(0.5 * servo.streams["effort:motor"], -1.0, 1.0)
    declared = dataclasses.replace(servo, metadata=law, streams={"effort:motor": effort})
    link = split(declared)["command -> effort", "motor"]
    assert link.sound and link.slope == pytest.approx(1.0, abs=1e-3)
    weaker = dataclasses.replace(declared, streams={"effort:motor": 0.8 * effort})
    link = split(weaker)["command -> effort", "motor"]
    assert not link.sound and link.slope == pytest.approx(0.8, abs=1e-3) and "off by -20 %" in link.text
    late = dataclasses.replace(declared, streams={"effort:motor": np.roll(effort, 5)})
    link = split(late)["command -> effort", "motor"]
    assert not link.sound and link.lag == pytest.approx(0.05, abs=0.003) and "50 ms late" in link.text


def test_the_fault_is_found_where_it_is(servo: Log) -> None:
    heavy = SERVO.replace('frictionloss="0.05"', 'frictionloss="0.6"')
    truth = record(heavy, sines((0.8,)), qvel=True, sigma=0.0)
    effort = KP * (truth.ctrl[:, 0] - truth.qpos[:, 0]) - KD * truth.qvel[:, 0]
    log = dataclasses.replace(truth, streams={"effort:motor": effort}, qvel=1.3 * truth.qvel)
    found = split(log, SERVO)
    assert not found["effort -> motion", "hinge"].sound  # the model lacks friction
    sensor = found["motion -> measurement", "hinge"]
    assert not sensor.sound and sensor.slope == pytest.approx(1.3, abs=0.02)
    truthful = dataclasses.replace(log, qvel=truth.qvel)
    assert split(truthful, SERVO)["command -> effort", "motor"].sound
    assert split(truthful, heavy)["effort -> motion", "hinge"].sound


def test_torque_commands_are_compared_with_the_motion() -> None:
    log = record(ARM, sines((3.0, 0.6)))
    found = split(log, ARM)
    for joint in ("shoulder", "elbow"):
        assert found["command -> motion", joint].sound, found
    assert found["command -> motion", "elbow"].slope == pytest.approx(1.0, abs=0.05)
    untested = found["command -> effort", "m_elbow"], found["motion -> measurement", "all joints"]
    assert all(not x.tested and not x.sound and np.isnan(x.slope) and "not tested" in x.text for x in untested)
    weak = split(dataclasses.replace(log, ctrl=log.ctrl * [1.0, 1.25]), ARM)
    assert weak["command -> motion", "elbow"].slope == pytest.approx(0.8, abs=0.05)
    assert weak["command -> motion", "shoulder"].sound


def test_nothing_to_test_is_said() -> None:
    log = record(SERVO, sines((0.8,)))
    assert all(not x.tested for x in split(log, SERVO).values())


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.skipif(not RAW.is_dir(), reason="no XL330 logs in ../shared/data")
def test_in_the_xl330_firmware_no_error_is_seen(tmp_path: Path) -> None:
    for path in sorted(RAW.glob("*.json")):
        run = json.loads(path.read_text())
        rows = {k: np.array([float(e[k]) for e in run["entries"]]) for k in run["entries"][0]}
        stem = tmp_path / f"kp{run['kp']}_{run['trajectory']}"
        np.savez(
            stem.with_suffix(".npz"),
            time=rows["timestamp"],
            ctrl=rows["goal_position"][:, None],
            qpos=rows["position"][:, None],
            joints=["servo"],
            actuators=["motor"],
            **{
                "effort:motor": ((rows["load"] + 32768) % 65536 - 32768) / 885,
                "enabled:motor": rows["torque_enable"],
            },
        )
        # duty = clip((goal - q) kp (4096 / 2 pi) / (256 * 885), +-1)
        law = {"law": "position", "kp": run["kp"] * 4096 / (2 * np.pi * 256 * 885), "limit": 1.0}
        stem.with_suffix(".yaml").write_text(json.dumps({"controller": law, "condition": f"kp{run['kp']}"}))
    spec = importlib.util.spec_from_file_location("servo_pendulum", ROOT / "tasks" / "servo_pendulum.py")
    assert spec is not None and spec.loader is not None
    task = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(task)
    logs = read_logs(tmp_path, mujoco.MjModel.from_xml_string(task.XML))
    assert len(logs) == 16 and {log.condition for log in logs} == {"kp100", "kp200", "kp400", "kp800"}
    for log in logs:
        found = split(log, task.XML)
        law = found["command -> effort", "motor"]
        assert law.sound and law.correlation > 0.998 and 0.965 < law.slope < 1.005 and law.lag == 0.0, law
    # the motor and gear are not: their scale alone differs by a third between conditions
    slopes = [split(log, task.XML)["effort -> motion", "servo"].slope for log in logs if "sin_sin" in log.name]
    assert max(slopes) / min(slopes) > 1.3
