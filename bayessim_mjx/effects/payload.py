"""Payload: a mass that the model does not know (a tool, a gripper's load, a battery, cables) sits on a body."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import inertial_site, native, uncompensated, with_inertials
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.parameters import editing, geometry

if TYPE_CHECKING:
    from mujoco import mjx

SWEEPS = 4  # of Jacobi's method: it converges quadratically, 3 are enough for float32
PAIRS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # plane of the rotation and its axis
POINT = 1e-9  # m^2, inertia over mass of a point in MuJoCo, which has none without
FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat")


def principal(inertia: jax.Array, quat: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Principal moments `[3]` and frame `[4]` of a symmetric matrix `[3, 3]` given in the frame `quat`.

    Jacobi's rotations instead of eigh: no LAPACK under vmap, and a diagonal matrix stays as it is, bit for bit. A loop:
    written out they are a fourth of the program around a pendulum's timestep.
    """

    def rotate(carry: tuple[jax.Array, jax.Array], axes: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        inertia, quat = carry
        one, two, about = axes
        scale = jnp.trace(inertia)
        off, apart = one @ inertia @ two / scale, (two @ inertia @ two - one @ inertia @ one) / scale
        # tan(angle) = 2 a_pq sgn(d) / (|d| + sqrt(d^2 + 4 a_pq^2)), d = a_qq - a_pp; 0 where a_pq = d = 0
        square = apart**2 + 4 * off**2
        below = jnp.abs(apart) + jnp.sqrt(jnp.where(square > 0, square, 1.0))
        angle = jnp.arctan(jnp.where(apart < 0, -2.0, 2.0) * off / below)
        plane, across = jnp.outer(one, one) + jnp.outer(two, two), jnp.outer(one, two) - jnp.outer(two, one)
        turn = jnp.outer(about, about) + jnp.cos(angle) * plane + jnp.sin(angle) * across
        return (turn.T @ inertia @ turn, _turned(quat, about, -angle)), None

    (inertia, quat), _ = jax.lax.scan(rotate, (inertia, quat), jnp.tile(jnp.eye(3)[np.array(PAIRS)], (SWEEPS, 1, 1)))
    return jnp.diagonal(inertia), quat


def _turned(quat: jax.Array, axis: jax.Array, angle: jax.Array) -> jax.Array:
    """quat * (rotation about a unit vector `[3]` in its own frame)."""
    w, v = quat[0], quat[1:]
    c, s = jnp.cos(angle / 2), jnp.sin(angle / 2)
    return jnp.concatenate([(c * w - s * (v @ axis))[None], c * v + s * (w * axis + jnp.cross(v, axis))])


def _loaded(
    mass: jax.Array, inertia: jax.Array, ipos: jax.Array, iquat: jax.Array, load: jax.Array, arm: jax.Array
) -> tuple[jax.Array, ...]:
    """One body's FIELDS with a point mass `load` at `arm` `[3]` from its centre of mass."""
    total = mass + load
    local = geometry.rotation(iquat).T @ arm
    # about the new centre of mass: I + mu (|r|^2 1 - r r^T), mu = m load / (m + load)
    reduced = mass * (load / total)
    moment = jnp.diag(inertia) + reduced * (jnp.sum(local**2) * jnp.eye(3) - jnp.outer(local, local))
    moments, frame = principal(moment, iquat)
    return total, moments, ipos + (load / total) * arm, frame


@dataclasses.dataclass(frozen=True)
class Payload(Effect):
    """A point mass fixed to a body: mass, centre of mass, inertia and all that MuJoCo derives from them.

    What carries the robot's own weight (`gravcomp`) does not carry it.

    Parameters: `mass`, kg, neutral 0; `com_x`, `com_y`, `com_z`, m, where it sits in the body's frame, from the body's
    own centre of mass; without effect where mass = 0.
    """

    name: ClassVar[str] = "payload"
    kind: ClassVar[str] = "body"
    noun: ClassVar[str] = "extra payload"
    lacks: ClassVar[str] = "an extra payload"
    separates: ClassVar[str] = "many poses with accelerations; a known payload of a different mass"
    tied: ClassVar[bool] = False  # no robot carries the same load on all of its links
    inertial: ClassVar[bool] = True
    star: ClassVar[bool] = True  # links carry along their axes, not in the corners of a box
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("mass", 0.0, 0.0, 1.0, unit="kg", per="carried", reach=(0.0, 1.0), grid=(0.01, 0.05, 0.2, 0.5)),
        *(
            Quantity(
                f"com_{axis}", 0.0, -0.1, 0.1, unit="m", per="tool", reach=(-1.0, 1.0), grid=(0.3, 0.5, 0.7), shape=True
            )
            for axis in "xyz"
        ),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """See `inertial_site`."""
        return inertial_site(self, mj_model, timestep, substeps)

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        load, arm = at.values(theta)[:, 0], at.values(theta)[:, 1:]
        mass, inertia, ipos, iquat = (getattr(model, field)[at.ids] for field in FIELDS)
        new = jax.vmap(_loaded)(mass, inertia, ipos, iquat, load, arm)
        return with_inertials(model, at.ids, dict(zip(FIELDS, new, strict=True)))

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        if not at.mj_model.ngravcomp:
            return memory, jnp.zeros(at.nv)
        load, arm = at.values(theta)[:, 0], at.values(theta)[:, 1:]
        place = (1 - load / step.model.body_mass[at.ids])[:, None] * arm  # the centre of mass has moved towards it
        return memory, uncompensated(at, step, load, place)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: the inertial of link and load together, as `on_model` has it; a body of its own beside `gravcomp`."""
        for body, i, own in reversed(list(native(spec, values))):  # a body that is added has a number after its host's
            if own["mass"] == 0:
                continue
            model = spec.copy().compile()
            if model.body_gravcomp[i]:
                at = model.body_ipos[i] + [own["com_x"], own["com_y"], own["com_z"]]
                load = body.add_body(
                    pos=at, ipos=np.zeros(3), mass=own["mass"], inertia=np.full(3, POINT * own["mass"])
                )
                load.explicitinertial = True
                continue
            editing.explicit(spec, body)
            mass, place, more = model.body_mass[i], model.body_ipos[i], own["mass"]
            arm, frame = np.array([own["com_x"], own["com_y"], own["com_z"]]), np.zeros(9)
            mujoco.mju_quat2Mat(frame, model.body_iquat[i])
            turn = frame.reshape(3, 3)
            # I + mu (|r|^2 1 - r r^T), mu = m load / (m + load), in the frame of the body
            spread = mass * more / (mass + more) * (arm @ arm * np.eye(3) - np.outer(arm, arm))
            moments, axes = np.linalg.eigh(turn @ np.diag(model.body_inertia[i]) @ turn.T + spread)
            axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a reflection
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, axes.ravel())
            body.mass, body.ipos = mass + more, place + more / (mass + more) * arm
            body.inertia, body.iquat, body.ialt.type = moments, quat, mujoco.mjtOrientation.mjORIENTATION_QUAT
        return None
