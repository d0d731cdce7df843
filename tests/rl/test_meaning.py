"""What observations mean, found by probing: against tasks whose observations are known."""

import json

import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.rl import export, meaning
from tests.rl.test_export import policy


def of(name: str, **settings: object) -> dict[str, object]:
    env = registry.make(name, **settings)
    found = meaning.of_task(env)
    assert found is not None
    return dict(zip(env.observation_names, found, strict=True))


def test_positions_and_velocities_of_the_cartpole() -> None:
    assert of("Cartpole") == {
        "cart_position": {"terms": {"qpos:slider_to_cart": 1.0}, "offset": 0.0, "unit": "m"},
        "cart_velocity": {"terms": {"qvel:slider_to_cart": 1.0}, "offset": 0.0, "unit": "m/s"},
        "pole_angle": {"terms": {"qpos:cart_to_pole": 1.0}, "offset": 0.0, "unit": "rad"},
        "pole_velocity": {"terms": {"qvel:cart_to_pole": 1.0}, "offset": 0.0, "unit": "rad/s"},
    }


def test_what_is_not_affine_is_not_known() -> None:
    """The servo's speed / 10; cosine and sine of its angle; those of the angle to its goal follow from no source."""
    found = of("ServoPendulum")
    assert found["speed"] == {"terms": {"qvel:servo": 0.1}, "offset": 0.0, "unit": "rad/s"}
    assert found["cos_q"] == {"terms": {"cos:servo": 1.0}, "offset": 0.0, "unit": "1"}
    assert found["cos_error"] is None and found["sin_error"] is None


@pytest.mark.slow
def test_of_a_quadruped() -> None:
    found = of("Anymal")
    assert found["LF_KFE_position"] == {"terms": {"qpos:LF_KFE": 1.0}, "offset": 0.8, "unit": "rad"}
    assert found["angular_velocity_y"] == {"terms": {"turning:root.y": 0.25}, "offset": 0.0, "unit": "rad/s"}
    assert found["gravity_z"] == {"terms": {"gravity:root.z": 1.0}, "offset": 0.0, "unit": "1"}
    assert found["RH_HFE_action"] == {"terms": {"action:RH_HFE": 1.0}, "offset": 0.0, "unit": "1"}
    assert found["command_yaw"] == {"terms": {"task:command_yaw": 0.25}, "offset": 0.0, "unit": ""}


def test_the_file_has_what_the_check_of_a_deployment_needs(tmp_path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
    env, own = registry.make("Pendulum", variant="bayessim2021"), policy()
    assert export.write(tmp_path / "policy.onnx", own, env) < 2e-6  # golden pairs too: none lies beyond the limit
    texts = onnxruntime.InferenceSession(tmp_path / "policy.onnx").get_modelmeta().custom_metadata_map
    facts = {key: json.loads(texts[key]) for key in ("observation_meaning", "observation_clip", "command_joint")}
    assert [entry["terms"] for entry in facts["observation_meaning"]] == [
        {"cos:hinge": 1.0}, {"sin:hinge": 1.0}, {"qvel:hinge": 1.0},
    ]  # fmt: skip
    assert facts["observation_clip"] == 100.0 and facts["command_joint"] == [None]  # a motor
    assert np.abs(json.loads(texts["golden_observation"])).max() <= 100.0
    np.testing.assert_allclose(json.loads(texts["normaliser_mean"]), np.asarray(own.normalizer.mean), rtol=1e-6)
