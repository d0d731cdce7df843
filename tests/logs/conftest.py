"""What tests of logs share."""

import sys
from pathlib import Path

import mujoco
import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    from log_files import ARM

    return mujoco.MjModel.from_xml_string(ARM)
