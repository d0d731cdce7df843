"""The corrected simulator as files: effects.yaml, the model for plain MuJoCo, and a URDF where it came from one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import mujoco

from bayessim_mjx import urdf
from bayessim_mjx.diagnosis.correction import Found, correction
from bayessim_mjx.diagnosis.fitting.simulable import one_line
from bayessim_mjx.diagnosis.phrases.advice import MODEL
from bayessim_mjx.effects.support import native, storage
from bayessim_mjx.parameters import ParameterSpace

URDF = "model_with_effects.urdf"
# what a URDF has elements for: effects, and attributes of recalibrated parameters
IN_URDF = ("coulomb_friction", "viscous_friction", "payload", "inertial_parameters")
CALIBRATED_IN_URDF = ("damping", "friction", "mass", "inertia", "com_x", "com_y", "com_z")


class Source(Protocol):
    """What is read of a robot: its known parameters, what gives a fresh specification (None: nothing), its URDF."""

    @property
    def space(self) -> ParameterSpace: ...
    @property
    def spec(self) -> Callable[[], mujoco.MjSpec] | None: ...
    @property
    def urdf(self) -> Path | None: ...


def write_outputs(diagnosis: Found, robot: Source, folder: str | Path) -> list[str]:
    """Write effects.yaml and, where the robot has a specification, model_with_effects.xml; of a URDF, a URDF too.

    Returns:
        One sentence for each thing that a file leaves out because its format has no element for it.
    """
    folder = Path(folder)
    found = correction(diagnosis, robot.space)
    effects, calibrated = found.effects, ParameterSpace(found.calibrated)
    every = [*calibrated.parameters, *(p for e in effects for p in e.space().parameters)]
    identified = {p.name: (p.mean, p.sd) for p in every if p.mean is not None and p.sd is not None}
    storage.write(folder / "effects.yaml", effects, identified, calibrated)
    for name in (MODEL, URDF):  # of an earlier diagnosis
        (folder / name).unlink(missing_ok=True)
    if robot.spec is None:
        return [f"{MODEL} is not written: a compiled model has no specification; give its MJCF or MjSpec"]
    source = robot.spec()
    spec, missing = native.write_model(source, calibrated, calibrated.nominal, effects)
    spec = _friction_acting(_at_home(spec, source.modelfiledir))
    left_out = "".join(f"  {sentence}\n" for sentence in missing)
    note = f"<!-- Not in this model:\n{left_out.replace('--', '- -')}-->\n" if missing else ""
    (folder / MODEL).write_text(note + spec.to_xml(), encoding="utf-8")
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / MODEL))
    except ValueError as error:
        return [f"{MODEL} does not load, use effects.yaml: {one_line(error)}"]
    said = [f"{MODEL} leaves out {sentence}" for sentence in missing]
    if robot.urdf is None:
        return said
    (folder / URDF).write_text(urdf.corrected(robot.urdf, source.compile(), model), encoding="utf-8")
    lacks = [f"{e.name} at {', '.join(e.places())}" for e in effects if e.name not in IN_URDF]
    lacks += [p.name for p in found.calibrated if p.attribute not in CALIBRATED_IN_URDF]
    has = "a URDF has friction and damping of joints and inertias of links"
    return [*said, *([f"{URDF} leaves out {', '.join(lacks)}: {has}"] if lacks else [])]


def _friction_acting(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Native friction is a constraint: where constraints are off as a whole, all others are now off one by one."""
    off = mujoco.mjtDisableBit
    if any(joint.frictionloss > 0 for joint in spec.joints):
        flags = int(spec.option.disableflags) & ~int(off.mjDSBL_FRICTIONLOSS)
        if flags & int(off.mjDSBL_CONSTRAINT):
            others = int(off.mjDSBL_CONTACT) | int(off.mjDSBL_LIMIT) | int(off.mjDSBL_EQUALITY)
            flags = flags & ~int(off.mjDSBL_CONSTRAINT) | others
        spec.option.disableflags = flags
    return spec


def _at_home(spec: mujoco.MjSpec, folder: str) -> mujoco.MjSpec:
    """Return the specification with its meshes and textures where they are, wherever its XML will lie."""
    assets = [*spec.meshes, *spec.hfields, *spec.skins]
    if not any(asset.file for asset in (*assets, *spec.textures)):
        return spec
    home = Path(folder).resolve()  # "": of a file that was named without its folder
    meshes, textures = spec.meshdir, spec.texturedir
    spec.meshdir, spec.texturedir = str((home / meshes).resolve()), str((home / textures).resolve())
    for asset, below in [*((asset, meshes) for asset in assets), *((texture, textures) for texture in spec.textures)]:
        # in full where it does not lie in the model's own folder of assets: an attached model's
        if folder and asset.file and not (home / below / asset.file).is_file():
            found = [path for path in home.rglob(Path(asset.file).name) if path.match(asset.file)]
            asset.file = str(found[0]) if len(found) == 1 else asset.file
    return spec
