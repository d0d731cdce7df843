"""A diagnosis whose effects the evidence chooses: probabilities, words and intervals of the result."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis import run
from tests.diagnosis import pendulums

FRICTION, SCALE = 0.06, (1.05, 0.97, 1.03)


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """Of logs with dry friction and other known parameters; five effects are on offer."""
    robot = pendulums.nominal(tmp_path_factory.mktemp("model"))
    logs = pendulums.recorded(friction=FRICTION, scale=SCALE, count=6)
    return run.diagnose(robot, logs, effects=list(pendulums.FEW), verdict_only=True)


@pytest.mark.slow
@pytest.mark.ci
def test_probabilities_come_with_the_answer(diagnosed):
    assert diagnosed.verdict == "effects" and [e.name for e in diagnosed.effects] == ["coulomb_friction"]
    told = {frozenset(e["effects"]): e for e in diagnosed.evidence}
    named = frozenset(["coulomb_friction@hinge"])
    assert told[named]["probability"] > 0.99 and told[named]["nats"] > 50
    assert told[frozenset()]["nats"] == 0 and told[frozenset()]["probability"] < 1e-6
    assert sum(e["probability"] for e in diagnosed.evidence) == pytest.approx(1.0, abs=2e-3)
    assert any(
        "Probability among all fitted explanations" in text and "one in a million" in text
        for text in diagnosed.sentences
    )


@pytest.mark.slow
@pytest.mark.ci
def test_intervals_hold_what_was_simulated_with(diagnosed):
    level = diagnosed.effects[0].parameters["level"]
    assert abs(level.mean - FRICTION) < 2.6 * level.sd and level.sd < 0.05 * FRICTION
    for name, true in zip(pendulums.NAMES, SCALE, strict=True):  # the armature is an eighth of the joint's inertia
        own = diagnosed.parameters[name]
        assert abs(own["mean"] - true) < 2.6 * own["sd"] and own["sd"] < 0.2
    covariance = np.array(diagnosed.covariance["matrix"])
    assert np.linalg.eigvalsh(covariance).min() > -1e-12 and len(covariance) == len(diagnosed.covariance["names"])
    assert 0.95 < diagnosed.gap.closed["realised"] <= 1.0 and diagnosed.gap.closed["nested"]
