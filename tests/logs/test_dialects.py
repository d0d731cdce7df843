"""Each planted fault of a dialect is read rightly, or refused with the key of the map that mends it; none silently."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log, LogMap, read_logs
from tests.logs.dialects import SERVO, TRUTH, Case, text
from tests.logs.dialects_of_habits import CASES as HABITS
from tests.logs.dialects_of_texts import CASES as TEXTS
from tests.logs.dialects_of_times import CASES as TIMES
from tests.logs.dialects_of_units import CASES as UNITS
from tests.logs.log_files import ARM, HEADER

CASES = {case.name: case for case in (*TEXTS, *TIMES, *UNITS, *HABITS)}
OWN = {"ctrl": ("m_shoulder", "m_elbow"), "qpos": ("shoulder", "elbow")}
MODELS = {"arm": mujoco.MjModel.from_xml_string(ARM), "servo": mujoco.MjModel.from_xml_string(SERVO)}


def read(path: Path, case: Case, log_map: Mapping[str, Any] | None) -> tuple[Log, str]:
    """Return the one log of a case, and all that was said."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        (log,) = read_logs(path, MODELS[case.model], log_map)
    return log, "\n".join(str(w.message) for w in said)


def true(log: Log, case: Case) -> None:
    truth = TRUTH if case.truth is None else case.truth
    nu = log.ctrl.shape[1]
    np.testing.assert_allclose(log.time - log.time[0], truth[:, 0] - truth[0, 0], atol=max(case.within, 2e-6))
    np.testing.assert_allclose(log.ctrl, truth[:, 1 : 1 + nu], atol=case.within)
    np.testing.assert_allclose(log.qpos, truth[:, 1 + nu :], atol=case.within)


def test_there_are_many_and_each_has_a_name_and_a_source() -> None:
    every = (*TEXTS, *TIMES, *UNITS, *HABITS)
    assert len(every) == len(CASES) >= 60
    assert all(":" in case.complaint for case in every)
    assert all(case.words for case in every if case.refused)


@pytest.mark.parametrize("name", CASES)
def test_a_dialect(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    path = tmp_path / "run.csv"
    path.write_bytes(case.content)
    if not case.refused:
        log, said = read(path, case, case.log_map)
        true(log, case)
        for word in case.words:
            assert word in said, said
        return
    with pytest.raises(UserError) as error, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_logs(path, MODELS[case.model], case.log_map)
    refusal = str(error.value)
    for word in case.words:
        assert word in refusal, refusal
    if case.mend is not None:
        log, _ = read(path, case, {**(case.log_map or {}), **case.mend})
        true(log, case)


def test_units_that_nothing_proves_are_warned_of_with_their_key(tmp_path: Path) -> None:
    """A joint without a range may turn on, and a velocity is only compared: neither is refused, none is silent."""
    case, path = CASES["degrees of a joint without a range, stated"], tmp_path / "run.csv"
    path.write_bytes(case.content)
    with pytest.warns(UserWarning, match=r"'qpos:shoulder' goes to and fro by 9.1\d turns in rad; .*unit: deg"):
        read_logs(path, MODELS["arm"])
    speeds = np.gradient(TRUTH[:, 3:], 0.01, axis=0)
    path.write_text(text(np.c_[TRUTH, 30 / np.pi * speeds], HEADER + ",qvel:shoulder,qvel:elbow"))
    with pytest.warns(UserWarning, match="qvel:shoulder is about 9.5.*`unit: rpm`"):
        read_logs(path, MODELS["arm"])
    whole = LogMap.read({"time": "time", **{s: {n: f"{s}:{n}" for n in names} for s, names in OWN.items()},
                         "qvel": {n: {"column": f"qvel:{n}", "unit": "rpm"} for n in OWN["qpos"]}})  # fmt: skip
    (log,) = read_logs(path, MODELS["arm"], whole)
    np.testing.assert_allclose(log.qvel, speeds, atol=1e-5)


def test_targets_of_a_declared_law_place_the_readings_too(tmp_path: Path) -> None:
    turned = TRUTH.copy()
    turned[:, 1:3] = TRUTH[:, 3:]
    turned[:, 3] += 2 * np.pi
    (tmp_path / "run.csv").write_text(text(turned))
    declared = {"metadata": {"controller": {"law": "position", "kp": 3.0, "limit": 2.0}}}
    with pytest.warns(UserWarning, match=r"1 turn\(s\) from 'ctrl:m_shoulder'.*offset: -6.283185"):
        (log,) = read_logs(tmp_path / "run.csv", MODELS["arm"], declared)
    np.testing.assert_allclose(log.qpos, TRUTH[:, 3:], atol=2e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (log,) = read_logs(tmp_path / "run.csv", MODELS["arm"])  # torques say nothing of a turn
    assert log.qpos[0, 0] > 6
