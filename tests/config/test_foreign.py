"""BayesSimIG's own task files load whole: what means nothing here is named in one note."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.config import (
    from_dict,
    load,
)  # fmt: skip
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import nuisance

ISAAC = {  # as BayesSimIG's files are made: other simulators' keys beside those that count here
    "Humanoid": """
env: {numEnvs: 4096, envSpacing: 5, episodeLength: 1000, isFlagrun: False, powerScale: 1.0, upWeight: 0.1,
  realParams: {weights: [1.0], means: [[1.9, 0.2]], stds: [[0.001, 0.001]]},
  asset: {assetRoot: somewhere, assetFileName: humanoid.xml}, plane: {staticFriction: 1.0, restitution: 0.0}}
sim: {substeps: 2, physx: {num_threads: 4, solver_type: 1, contact_offset: 0.02}, flex: {warm_start: 0.25}}
bayessim: {trainTrajs: 10000, collectPolicy: policy_random, summarizerFxn: summary_start, trainTrajLen: 10, ftune: True,
  modelClass: MDNN, components: 10, hiddenLayers: [128, 128], lr: 1.e-4, realEvals: 100, realTrajs: 1, realIters: 100,
  ftuneRL: False}
task:
  randomize: True
  randomization_params:
    actions: {range: [0., 0.1], operation: additive, distribution: gaussian, schedule: constant, schedule_steps: 0}
    actor_params:
      torso:
        color: True
        rigid_body_properties:
          mass: {range: [0.1, 2.0], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
        dof_properties:
          stiffness: {range: [0.0, 10.0], operation: additive, distribution: uniform, schedule: constant}
""",
    "ShadowHand": """
env: {numEnvs: 1024, envSpacing: 0.75, maxEpisodeLength: 600, aggregateMode: 1, objectType: block, rotEps: 0.1,
  observationType: full_state, asymmetric_observations: False, useRelativeControl: False, dofSpeedScale: 20.0,
  actionsMovingAverage: 1.0, successTolerance: 0.1, fallDistance: 0.24, fallPenalty: 0.0, reachGoalBonus: 250,
  realParams: {weights: [1.0], means: [[1.8]], stds: [[0.001]]}, asset: {assetFileName: hand.xml}}
sim: {substeps: 2, physx: {num_threads: 4}}
bayessim: {trainTrajs: 50000, components: 4, lr: 1.e-4}
task:
  randomize: True
  randomization_params:
    observations: {range: [0, .002], range_correlated: [0, .001], operation: additive, distribution: gaussian,
      schedule: linear, schedule_steps: 40000}
    actions: {range: [0., .05], range_correlated: [0, .015], operation: additive, distribution: gaussian,
      schedule: linear, schedule_steps: 40000}
    sim_params:
      gravity: {range: [0, 0.4], operation: additive, distribution: gaussian, schedule: linear, schedule_steps: 40000}
    frequency: 720
    actor_params:
      hand:
        color: True
        tendon_properties:
          stiffness: {range: [0, 200], operation: additive, distribution: uniform, schedule: constant}
        rigid_body_properties:
          mass: {range: [0.1, 10], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
      object:
        scale: {range: [0.5, 2.0], operation: scaling, distribution: uniform, schedule: constant, setup_only: True}
        rigid_body_properties:
          mass: {num_buckets: 250, range: [0.1, 10], operation: scaling, distribution: uniform, setup_only: True}
""",
    "FrankaCabinet": """
env: {numEnvs: 2048, envSpacing: 1.5, episodeLength: 500, startPositionNoise: 0.0, startRotationNoise: 0.0,
  numProps: 16, aggregateMode: 3, actionScale: 7.5, dofVelocityScale: 0.1, distRewardScale: 1.5, rotRewardScale: 0.5,
  aroundHandleRewardScale: 1.0, openRewardScale: 4.0, fingerDistRewardScale: 10.0, actionPenaltyScale: 0.01,
  realParams: {weights: [1.0], means: [[0.8, 0.1]], stds: [[0.001, 0.001]]}, asset: {assetRoot: somewhere}}
sim: {substeps: 1, physx: {num_threads: 4}}
bayessim: {trainTrajs: 10000, collectPolicy: policy_random, summarizerFxn: summary_start, trainTrajLen: 10, lr: 1.e-4}
task:
  randomize: True
  randomization_params:
    actor_params:
      franka:
        color: True
        rigid_body_properties:
          mass: {range: [0.01, 1.0], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
        dof_properties:
          stiffness: {range: [0.1, 2.0], operation: scaling, distribution: uniform, schedule: constant}
""",
    "Anymal": """
env: {numEnvs: 4000, envSpacing: 4., realParams: {weights: [1.0], means: [[4.0, 0.2]], stds: [[0.001, 0.001]]},
  plane: {staticFriction: 1.0}, baseInitState: {pos: [0.0, 0.0, 0.62]}, randomCommandVelocityRanges: {yaw: [-1., 1.]},
  control: {stiffness: 85.0, damping: 2.0, actionScale: 0.5}, defaultJointAngles: {LF_HAA: 0.03},
  urdfAsset: {fixBaseLink: False}, learn: {torqueRewardScale: -0.000025, episodeLength_s: 50}, viewer: {refEnv: 0},
  asset: {assetRoot: somewhere}}
sim: {substeps: 2, physx: {num_threads: 4}}
bayessim: {trainTrajs: 10000, collectPolicy: policy_random, summarizerFxn: summary_corrdiff, trainTrajLen: 20}
task:
  randomize: True
  randomization_params:
    actor_params:
      anymal:
        color: True
        rigid_body_properties:
          mass: {range: [0.01, 5.0], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
""",
    "Pendulum": """
env: {numEnvs: 100, episodeLength: 200, realParams: {weights: [1.0], means: [[1.0, 0.5]], stds: [[1.0e-5, 1.0e-5]]}}
rkhsnet: {enable: True, nFeat: 100}
bayessim: {trainTrajs: 10000, summarizerFxn: summary_start, realIters: 20, lr: 1.e-4}
task:
  randomize: True
  randomization_params:
    actor_params:
      pendulum:
        rigid_body_properties: {mass: {range: [0.01, 2.0], operation: scaling, schedule: constant}}
        rigid_shape_properties: {length: {range: [0.01, 2.0], operation: scaling, distribution: uniform}}
""",
}


LEFT_OUT = {
    "Humanoid": "sim, env.envSpacing, env.isFlagrun, env.powerScale, env.upWeight, env.asset, env.plane, color",
    "ShadowHand": "sim, env.envSpacing, env.aggregateMode, env.objectType, env.rotEps, env.fallDistance, "
    "env.reachGoalBonus, env.asset, color, setup_only, num_buckets",
    "FrankaCabinet": "sim, env.envSpacing, env.startPositionNoise, env.startRotationNoise, env.numProps, "
    "env.aggregateMode, env.actionScale, env.dofVelocityScale, env.distRewardScale, env.rotRewardScale, "
    "env.aroundHandleRewardScale, env.openRewardScale, env.fingerDistRewardScale, env.actionPenaltyScale, env.asset, "
    "color",
    "Anymal": "sim, env.envSpacing, env.plane, env.baseInitState, env.randomCommandVelocityRanges, env.control, "
    "env.defaultJointAngles, env.urdfAsset, env.learn, env.viewer, env.asset, color",
    "Pendulum": "rkhsnet",
}


MORE = """
env: {numEnvs: 10000, maxEpisodeLength: 600, realParams: {weights: [1.0], means: [[1.8]], stds: [[0.001]]}}
bayessim: {trainTrajs: 20000, summarizerFxn: summary_corrdiff, trainTrajLen: 50, fullCovariance: False}
task:
  randomize: True
  randomization_params:
    frequency: 720
    actor_params:
      hand:
        color: True
        tendon_properties:
          damping: {range: [0.3, 3.0], operation: scaling, distribution: uniform, schedule: constant}
          stiffness: {range: [0, 200], operation: additive, distribution: uniform, schedule: constant}
        dof_properties:
          damping: {range: [0.3, 3.0], operation: scaling, distribution: uniform, schedule: constant}
          stiffness: {range: [0.1, 5.0], operation: scaling, distribution: uniform, schedule: constant}
        rigid_body_properties:
          mass: {range: [0.1, 10], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
        rigid_shape_properties:
          friction: {num_buckets: 250, range: [0.01, 10], operation: scaling, distribution: uniform}
      object:
        scale: {range: [0.5, 2.0], operation: scaling, distribution: uniform, setup_only: True}
        rigid_body_properties:
          mass: {range: [0.1, 10], operation: scaling, distribution: uniform, setup_only: True}
        rigid_shape_properties:
          friction: {num_buckets: 250, range: [0.01, 10], operation: scaling, distribution: uniform}
"""  # as BayesSimIG's file with more than 100 parameters is made


BODY = """<mujoco model="hand"><worldbody><body name="torso"><freejoint/><geom name="palm" size=".1"/><body name="arm">
<joint name="elbow" axis="0 1 0"/><geom size=".05" pos=".1 0 0"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("task", ISAAC)
def test_files_made_like_bayessimigs_load_whole_with_one_note(task: str, tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(ISAAC[task])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded = load(task, cfg_env=tmp_path / "f.yaml")
    assert [str(w.message).partition("nothing here: ")[2] for w in caught] == [LEFT_OUT[task]]
    assert str(caught[0].message).startswith(f"{tmp_path}/f.yaml: ")
    section = loaded.to_dict()["task"]
    if task == "Pendulum":
        assert registry.make(task, config=loaded).space.names == ("pendulum_mass_mult", "pendulum_length_mult")
        return
    if task in ("Anymal", "FrankaCabinet"):
        assert registry.make(task, config=loaded).space == registry.make(task).space
        return
    if task == "ShadowHand":
        space = registry.make(task, config=loaded).space
        assert space == registry.make(task).space
    else:
        space = ParameterSpace.from_config(section, mujoco.MjModel.from_xml_string(BODY))
        assert space.names == ("torso_mass_mult", "arm_mass_mult", "elbow_stiffness")
    found = nuisance.read(section["randomization_params"], space)
    assert found is not None
    spread = found.actions.white
    if task == "Humanoid":
        assert loaded.env.episodeLength == 1000
        assert (spread.first, spread.second, found.observations, found.frequency) == (0.0, 0.1, None, 1)
    else:
        assert loaded.env.episodeLength == 600 and found.frequency == 720 and found.gravity.white.second == 0.4
        assert (found.observations.lasting.second, found.actions.schedule.steps) == (0.001, 40000)
    assert from_dict(loaded.to_dict()) == loaded


def test_names_of_one_length_agree_and_slips_are_still_refused(tmp_path: Path) -> None:
    assert load("Pendulum", overrides=["env.maxEpisodeLength=30"]).env.episodeLength == 30
    (tmp_path / "f.yaml").write_text("env: {episodeLength: 3, maxEpisodeLength: 4}\n")
    with pytest.raises(UserError, match=r"env\.episodeLength = 3 and env\.maxEpisodeLength = 4 are one setting"):
        load("Pendulum", cfg_env=tmp_path / "f.yaml")
    for text, word in (("env: {envSpacin: 1}", "env.envSpacin"), ("simm: {}", "simm")):
        (tmp_path / "f.yaml").write_text(text)
        with pytest.raises(UserError, match=f"key '{word}' is unknown"):
            load("Pendulum", cfg_env=tmp_path / "f.yaml")
    assert load("Cartpole", overrides=["env.resetDist=2"]).env["resetDist"] == 2.0  # the task has it


def test_the_hand_with_more_parameters_loads(tmp_path: Path) -> None:
    """A factor on a joint's stiffness that is 0 is one on 0.1 N m/rad, to which BayesSimIG sets such joints."""
    (tmp_path / "f.yaml").write_text(MORE)
    with pytest.warns(UserWarning, match="left out, as they mean nothing here: color, num_buckets, setup_only"):
        loaded = load("ShadowHand", cfg_env=tmp_path / "f.yaml")
    env = registry.make("ShadowHand", config=loaded)
    assert len(env.space) > 100 and len(set(env.space.names)) == len(env.space)
    before = env.spec().compile()
    after = env.space.edit(env.spec(), np.full(len(env.space), 1.8)).compile()
    drive, joint = before.actuator("FFJ1").id, before.joint("FFJ0").id
    assert (before.jnt_stiffness == 0).all() and before.joint("FFJ0").id not in before.actuator_trnid[:, 0]
    held = {before.joint(j).name: s for j, s in enumerate(after.jnt_stiffness) if s}
    assert held == pytest.approx({"FFJ0": 0.18, "MFJ0": 0.18, "RFJ0": 0.18, "LFJ0": 0.18}, rel=1e-6)
    assert after.actuator_gainprm[drive, 0] == pytest.approx(1.8 * before.actuator_gainprm[drive, 0])  # a drive's own
    dof = before.jnt_dofadr[joint]
    assert after.dof_damping[dof] == pytest.approx(1.8 * before.dof_damping[dof])
    assert after.tendon_damping == pytest.approx(1.8 * before.tendon_damping)
    assert after.tendon_stiffness == pytest.approx(before.tendon_stiffness + 1.8)
    own = dict(zip(env.space.names, env.space.parameters, strict=True))
    assert own["FFJ0_stiffness_mult"].nominal == 0.1  # 0.01 N m/rad: what is nearest to none


def test_what_stands_for_a_number_that_is_0_can_be_said_of_any_attribute() -> None:
    joints = {"stiffness": {"range": [0.5, 2], "operation": "scaling"}}
    section = {"actor_params": {"hand": {"dof_properties": joints}}}
    model = mujoco.MjModel.from_xml_string(BODY)
    with pytest.raises(UserError, match="elbow: scaling a number that is 0 .* or give what stands for it: `zero: NUM"):
        ParameterSpace.from_config(section, model)
    joints["stiffness"]["zero"] = 3.0
    space = ParameterSpace.from_config(section, model)
    assert space.names == ("elbow_stiffness_mult",)
    edited = space.edit(mujoco.MjSpec.from_string(BODY), [1.5]).compile()
    assert edited.joint("elbow").stiffness[0] == pytest.approx(4.5)
