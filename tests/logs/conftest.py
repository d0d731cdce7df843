"""What tests of logs share."""

import mujoco
import pytest


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    from tests.logs.log_files import ARM

    return mujoco.MjModel.from_xml_string(ARM)
