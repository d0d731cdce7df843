"""A diagnosis of logs in which not every joint was measured."""

import dataclasses

import pytest

from bayessim_mjx import diagnosis
from bayessim_mjx.diagnosis import run
from bayessim_mjx.logs import write_log
from tests.diagnosis.recordings import ARM, record, sines

LEVEL = 0.3  # N m, of the joint without an encoder
NOMINAL = ARM.replace('timestep="0.001"', 'timestep="0.01"')
TRUE = ARM.replace('timestep="0.001"', 'timestep="0.0005" integrator="RK4"').replace(
    'damping="0.1"', f'damping="0.1" frictionloss="{LEVEL}"'
)


# not in CI: motion that was not measured is estimated in fitting/test_observation.py, an elbow's friction is found in
# test_docs.py::test_the_how_to_of_an_own_robot_finds_its_hidden_friction
@pytest.mark.slow
def test_friction_of_a_joint_that_was_not_measured(tmp_path, monkeypatch):
    """MuJoCo C at a twentieth of the step; only the shoulder has an encoder, and the elbow the friction."""
    stages = [stage for stage in run.STAGES if stage.name != "next experiment"]
    monkeypatch.setattr(run, "STAGES", tuple(dataclasses.replace(stage, optional=False) for stage in stages))
    for i in range(4):
        law = sines((5.0, 1.5), pace=0.3 + 0.1 * i, seed=i)
        log = record(TRUE, law, seconds=2.0, period=0.02, sigma=1e-3, seed=i)
        write_log(tmp_path / "logs" / f"run{i}.csv", dataclasses.replace(log, absent=("qpos:elbow",)))
    (tmp_path / "arm.xml").write_text(NOMINAL)
    found = diagnosis.diagnose(
        tmp_path / "arm.xml", tmp_path / "logs", effects=["coulomb_friction"], quick=True, out=tmp_path / "found"
    )
    assert found.verdict == "effects" and [(e.name, e.where) for e in found.effects] == [("coulomb_friction", "elbow")]
    assert found.effects[0].parameters["level"].mean == pytest.approx(LEVEL, rel=0.1)
    assert found.effects[0].gap_closed > 0.8
    assert set(found.gap.physical) == set(found.gap.by_channel) == {"shoulder"}
    assert any("no column qpos:elbow: this motion is estimated" in text for text in found.warnings)
    assert not any("not available" in text for text in found.warnings)  # where it lies, too
    assert found.where[0].share == max(place.share for place in found.where) > 0.5
    loaded = diagnosis.load(tmp_path / "found")
    assert loaded.to_dict() == found.to_dict()
