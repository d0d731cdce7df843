"""What tests of runs share."""

from pathlib import Path

import pytest

from bayessim_mjx import config
from bayessim_mjx.runs import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path, "Pendulum", "t", config.load("Pendulum"), "main --task Pendulum")
