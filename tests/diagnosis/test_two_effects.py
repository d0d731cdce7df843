"""A diagnosis of two effects at once: the longest, and so no test of CI's; benchmarks/diagnosis counts many."""

import pytest

from .pendulums import recorded
from .test_run import diagnosed


@pytest.mark.slow
def test_two_effects_are_both_named(tmp_path):
    found, diagnosis = diagnosed(tmp_path, recorded(friction=0.06, delay=0.008, scale=(1.1, 0.92, 1.05), seed=3))
    assert {e.name for e in diagnosis.effects} == {"coulomb_friction", "actuator_delay"}
    assert diagnosis.verdict in ("effects", "ambiguous")
    numbers = {e.name: next(iter(e.parameters.values())).mean for e in diagnosis.effects}
    assert numbers["coulomb_friction"] == pytest.approx(0.06, rel=0.1)
    assert numbers["actuator_delay"] == pytest.approx(0.008, rel=0.1)
    assert sum(e.share for e in diagnosis.effects) == pytest.approx(1.0)
    assert all(e.share > 0.02 for e in diagnosis.effects)
    assert len(found.selection.subsets) == 4 and found.selection.subsets[frozenset()] is found.selection.state.base
