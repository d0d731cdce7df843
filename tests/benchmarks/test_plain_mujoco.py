"""The cases in plain MuJoCo: each cause moves the arm, by what its truth says; nothing hides where there is none."""

import json

import numpy as np
import plain_mujoco as plain
import pytest


def test_a_folder_is_what_diagnose_reads(tmp_path):
    plain.main(["--out", str(tmp_path), "--kinds", "soft_friction", "--write_only"])
    folder = tmp_path / "soft_friction"
    assert json.loads((folder / "truth.json").read_text())["numbers"] == {"level": 0.15}
    assert "frictionloss" not in (folder / "robot.xml").read_text()
    assert len(list((folder / "logs").glob("*.csv"))) == plain.LOGS


@pytest.mark.parametrize("name", [n for n, kind in plain.KINDS.items() if kind.effect])
def test_each_cause_moves_the_arm_and_nothing_else_does(name):
    first, again, other = (
        plain.record(plain.KINDS[which], np.random.default_rng(0)) for which in ("nothing", "nothing", name)
    )
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(other[:, 5:], first[:, 5:])  # the same commands
    assert np.sqrt(np.mean((other - first)[:, 1:3] ** 2)) > 5 * plain.NOISE[0]
