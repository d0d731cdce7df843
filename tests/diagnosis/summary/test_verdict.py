"""The name of a verdict where effects are named: by what they leave, in noises and as a share of the gap."""

from types import SimpleNamespace

import pytest

from bayessim_mjx.diagnosis.summary import verdict


def named(left: float, calibrated: float, noise: object = None) -> str:
    """The verdict on effects that leave so many noises (rms) of so many that recalibration leaves."""
    found = SimpleNamespace(
        model=SimpleNamespace(effects=("x",)),
        selection=SimpleNamespace(state=SimpleNamespace(above_noise=lambda model: False), ambiguous=False),
        flexible_winner=None,
    )
    far = SimpleNamespace(beyond=(), coasting=None, calibrated=calibrated, with_effects=left)
    return verdict._name(found, far, 0.0, False, noise)


@pytest.mark.parametrize(
    ("left", "calibrated", "name"),
    [
        (1.3, 1.9, "unexplained"),  # .69 of 2.61: a quarter of the squared gap above the noise
        (1.15, 1.5, "effects"),  # as large a share, but hardly above the noise
        (1.4, 4.0, "effects"),  # a sixteenth
        (2.0, 4.0, "unexplained"),
        (1.04, 3.0, "effects"),
    ],
)
def test_effects_that_leave_much_of_the_gap_do_not_explain_it(left, calibrated, name):
    assert named(left, calibrated) == name


def test_noise_larger_than_estimated_is_no_gap_that_effects_leave():
    assert named(1.3, 1.9, noise=SimpleNamespace(of_sensors=True)) == "effects"
