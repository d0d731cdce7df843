"""Recordings of real robots pass the gate with the notes that they deserve; skipped where they are absent."""

import importlib.util
from pathlib import Path

import mujoco
import pytest

from bayessim_mjx.diagnosis.logcheck.gate import check
from bayessim_mjx.logs import read_logs
from tests.diagnosis.recordings import PENDULUM, make

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
ROOT = Path(__file__).resolve().parents[3]
DFKI = """
<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
  <geom type="sphere" size=".05" mass=".546" pos="0 0 -.5"/>
  <geom type="capsule" size=".01" fromto="0 0 0 0 0 -.5" mass=".13"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
DFKI_MAP = """
files: "*measured*.csv"
ctrl: {motor: torque}
qpos: {hinge: position}
qvel: {hinge: velocity}
"""


def model(xml: str = PENDULUM) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.skipif(not (DATA / "dfki_simple_pendulum").is_dir(), reason="no DFKI pendulum logs in ../shared/data")
def test_dfki_pendulum(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(DFKI_MAP)
    logs = read_logs(DATA / "dfki_simple_pendulum", model(DFKI), tmp_path / "map.yaml")
    gate = check(logs, model(DFKI), 0.005)
    names = {log.name.removeprefix("control_method_").split("_data_")[0] + log.name[-7:-4] for log in gate.usable}
    refusals = {n.removeprefix("control_method_"): r for n, r in gate.refused.items()}
    assert set(refusals) == {
        "energy_shaping_data_measured.csv",
        "energy_shaping_data_measured_1kg.csv",
        "sac_data_measured.csv",
    }
    assert all("effort unrelated to motion" in r and "unexplained" in r for r in refusals.values())
    assert {"ddpred", "gravity_compensationred"} <= names
    ddp = next(r for r in gate.reports if "ddp" in r.log.name)
    assert not ddp.remarks and (ddp.relations[0].explained or 0) > 0.98


@pytest.mark.skipif(not (DATA / "emps").is_dir(), reason="no EMPS data in ../shared/data")
@pytest.mark.parametrize("file", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"])
def test_emps_passes(file: str) -> None:
    from scipy.io import loadmat

    slide = model("""<mujoco><worldbody><body><joint name="carriage" type="slide" axis="1 0 0"/>
      <geom size=".1" mass="95.1"/></body></worldbody>
      <actuator><motor name="motor" joint="carriage"/></actuator></mujoco>""")
    raw = loadmat(DATA / "emps" / file)
    force = float(raw["gtau"].item()) * raw["vir"].reshape(-1, 1)
    log = make(slide, raw["t"].ravel(), force, raw["qm"].reshape(-1, 1), name=file)
    gate = check([log], slide, 0.001)
    assert gate.usable and (gate.reports[0].relations[0].explained or 0) > 0.97, gate.warnings


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.skipif(not (DATA / "xl330_servo").is_dir(), reason="no XL330 logs in ../shared/data")
def test_xl330_passes(tmp_path: Path) -> None:
    def module(path: Path):
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(loaded)
        return loaded

    servo = model(module(ROOT / "tasks" / "servo_pendulum.py").XML)
    module(ROOT / "examples" / "convert_xl330.py").convert(tmp_path)
    gate = check(read_logs(tmp_path, servo), servo, 0.005)
    assert len(gate.usable) == 16 and not gate.refused
    assert all((r.relations[0].explained or 0) > 0.9 for r in gate.reports)
