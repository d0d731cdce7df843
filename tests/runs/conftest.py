"""What tests of runs share."""

import sys
from pathlib import Path

import pytest

from bayessim_mjx import config
from bayessim_mjx.runs import Run

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path, "Pendulum", "t", config.load("Pendulum"), "main --task Pendulum")
