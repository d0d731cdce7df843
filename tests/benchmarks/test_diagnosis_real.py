"""The real robots' conversions and measures against what was published of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import real

from bayessim_mjx.logs import read_logs

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="no published logs in ../shared/data")


@pytest.fixture(scope="module")
def emps(tmp_path_factory):
    out = tmp_path_factory.mktemp("emps")
    real.source.convert_emps(DATA, out)
    return out


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(
    ("values", "percent"),  # of the authors' parameters, and without friction and offset
    [((95.1089, 203.5034, 20.3935, 3.1648), 4.04), ((95.1089, 0.0, 0.0, 0.0), 69.3)],
)
def test_the_force_error_of_emps_is_the_published_one(emps, values, percent):
    physics, published = real._published(emps)
    theta = np.array(values) / np.array([90.0, 1.0, 1.0, 1.0])
    if percent < 5:
        np.testing.assert_allclose(theta, published)
    (log,) = read_logs(emps / "logs", physics.mj_model)
    time, missing, given = real.force_error(physics, theta, log)
    assert len(time) == len(missing) == len(given) > 24000
    assert 100 * real.relative(missing, given) == pytest.approx(percent, rel=0.03)


def test_the_pulses_are_kept_from_the_diagnosis(emps):
    assert [p.name for p in (emps / "logs").glob("*.csv")] == ["DATA_EMPS.csv"]
    assert [p.name for p in (emps / "validation").glob("*.csv")] == ["DATA_EMPS_PULSES.csv"]


def test_the_position_law_of_the_xl330_gives_the_logged_duty(tmp_path):
    real.source.convert_xl330(DATA, tmp_path)
    slopes = []
    for path in sorted((DATA / "xl330_servo" / "raw").glob("*.json")):
        run = json.loads(path.read_text())
        stem = tmp_path / "logs" / f"kp{run['kp']}_{run['trajectory']}"
        law = json.loads(stem.with_suffix(".yaml").read_text())["controller"]
        header = stem.with_suffix(".csv").open().readline().strip().split(",")
        row = dict(zip(header, np.loadtxt(stem.with_suffix(".csv"), delimiter=",", skiprows=1).T, strict=True))
        volts = np.clip(law["kp"] * (row["ctrl:motor"] - row["qpos:servo"]), -law["limit"], law["limit"])
        load = np.array([e["load"] for e in run["entries"]])
        duty = ((load + 32768) % 65536 - 32768) / 885
        on = row["enabled:motor"] > 0
        slopes.append(np.polyfit(volts[on] / run["vin"], duty[on], 1)[0])
        assert np.corrcoef(volts[on], duty[on])[0, 1] > 0.995, stem.name
    assert len(slopes) == 16 and min(slopes) > 0.96 and max(slopes) < 1.01


@pytest.mark.slow
@pytest.mark.ci
def test_what_is_wrong_with_the_logs_of_the_dfki_pendulum(tmp_path, capsys):
    assert real.main(["dfki", "--data", str(DATA), "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "real.json").read_text())
    refused = {n.removeprefix("control_method_").split("_data")[0] for n, r in found["logs"].items() if "refused" in r}
    assert refused == {"energy_shaping", "sac"} and sum("refused" in r for r in found["logs"].values()) == 3
    assert all("effort unrelated to motion" in r["refused"][0] for r in found["logs"].values() if "refused" in r)
    assert found["exit_code_of_refused_alone"] == 2 and "no usable log" in capsys.readouterr().err
    assert found["logs"]["control_method_ddp_data_measured.csv"] == {"usable": True}


def test_no_data_is_said_in_one_line(tmp_path, capsys):
    assert real.main(["emps", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "it has no folder emps" in capsys.readouterr().err


@pytest.mark.slow
def test_the_recalibrated_xl330_is_as_wrong_as_its_notes_say(tmp_path):
    real.source.convert_xl330(DATA, tmp_path)
    robot = real.of_file(tmp_path / "model.xml", tmp_path / "params.yaml")
    logs = read_logs(tmp_path / "logs", robot.mj_model)
    physics = robot.physics(real.control_period(robot, logs))
    error = real.held_out(physics, physics.space.nominal, logs)
    assert 1e3 * error["all"] == pytest.approx(84.5, rel=0.05)
