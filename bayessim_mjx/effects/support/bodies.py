"""Bodies, the joints that move them and gravity, shared by the effects on them; and bodies of a spec by place."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.quantity import Quantity
from bayessim_mjx.effects.support.site import Site, find, floating
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.effects.support.transmission import inverse
from bayessim_mjx.parameters import attributes, editing

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mujoco import mjx

    from bayessim_mjx.effects.effect import Effect

TINY = 1e-12  # m^2/s^2, of a speed of 0
ASIDE = 1e-3  # m, an offset that MuJoCo's compiler does not take for 0 (1e-6, measured); it is taken back
ROUNDS = 2  # of finding the speed half-way; the first begins at that of the start
# numbers of the drag of a floating body; ranges without knowledge of the robot: those of a small drone
DRAG = (
    Quantity("linear", 0.0, 0.0, 5.0, unit="N s/m", per="force/speed", reach=(0.0, 2.0), grid=(0.01, 0.05, 0.3)),
    Quantity("quadratic", 0.0, 0.0, 5.0, unit="N s^2/m^2", per="force/speed^2", reach=(0.0, 2.0), grid=(0.01, 0.1)),
    Quantity("turning", 0.0, 0.0, 0.5, unit="N m s/rad", per="moment/rate", reach=(0.0, 2.0), grid=(0.05,)),
)


def moved(model: mujoco.MjModel) -> np.ndarray:
    """`[nbody, nv]`, 1 where the degree of freedom moves the body."""
    above = np.eye(model.nbody, dtype=np.float32)  # [b, a]: a is b or above b
    for b in range(1, model.nbody):
        above[b] += above[model.body_parentid[b]]
    return above[:, model.dof_bodyid]


def velocity(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray) -> jax.Array:
    """Velocities of the bodies' centres of mass in the world `[n, 3]`, m/s."""
    angular, linear = jnp.split(data.cvel[ids], 2, axis=1)
    return linear + jnp.cross(angular, _arm(model, data, ids))


def project(
    model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray, force: jax.Array, away: jax.Array | float = 0.0
) -> jax.Array:
    """Generalised force `[nv]` of forces `[n, 3]` (N, world) at the bodies' centres of mass, or `away` `[n, 3]` of it.

    away: m, in the world's axes.
    """
    wrench = jnp.concatenate([jnp.cross(_arm(model, data, ids) + away, force), force], axis=1)
    return jnp.sum(data.cdof * (moved(model)[ids].T @ wrench), axis=1)  # sum_b J_b^T f_b


def resisted(at: Site, step: SubStep, drag: jax.Array, medium: jax.Array, axes: jax.Array | None = None) -> jax.Array:
    """Generalised force `[nv]` of drag at the site's bodies, each in a tree of its own, half-way through the sub-step.

    (1 + dt K A / 2) f = -K (velocity with all other forces, half-way), A = J M^-1 J^T, K = diag(r, r, r, q a), in the
    body's axes, q = k + c |velocity half-way|: second order in dt where speeds lie half a sub-step before positions.

    Args:
        drag: `[n, 3]` (k, c, r) of DRAG, >= 0; medium: `[n, 3]` or `[3]`, its velocity in the world, m/s.
        axes: `[n, 3]`, factors a of the body's axes; None: 1.
    """
    frame = jnp.swapaxes(jnp.reshape(step.data.xmat, (-1, 3, 3))[at.ids], 1, 2)
    jacobian = _jacobian(at.mj_model, step.data, at.ids, frame)
    still = jnp.matmul(frame, jnp.broadcast_to(medium, (len(at), 3))[..., None])[..., 0]
    still = jnp.concatenate([jnp.zeros((len(at), 3)), still], axis=1)
    now = jnp.sum(jacobian * step.qvel, axis=-1) - still
    half, unit = 0.5 * step.dt, jnp.eye(6)
    later = now + half * jnp.sum(jacobian * jnp.sum(step.inverse * step.force, axis=-1), axis=-1)
    out = jnp.zeros(at.nv)
    for i in range(len(at)):
        along, quadratic, turning = drag[i]
        share = jnp.ones(3) if axes is None else axes[i]
        mobility, middle, force = jnp.matmul(jnp.matmul(jacobian[i], step.inverse), jacobian[i].T), now[i], now[i]
        for _ in range(ROUNDS):
            square = jnp.sum(middle[3:] ** 2)
            speed = jnp.sqrt(jnp.where(square > 0, square, TINY))  # where: the root has no slope at 0
            own = jnp.concatenate([jnp.full(3, turning), (along + quadratic * speed) * share])
            force = -jnp.matmul(inverse(unit + half * own[:, None] * mobility), own * later[i])
            middle = later[i] + half * jnp.matmul(mobility, force)
        out = out + jnp.sum(jacobian[i] * force[:, None], axis=0)
    return out


def _jacobian(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray, frame: jax.Array) -> jax.Array:
    """`[n, 6, nv]`, angular velocity and that of the centre of mass, by qvel; frame: `[n, 3, 3]`, axes of bodies."""
    turn, move = jnp.split(data.cdof, 2, axis=1)
    move = move + jnp.cross(turn, _arm(model, data, ids)[:, None])  # [n, nv, 3]
    turn = jnp.broadcast_to(turn, move.shape)
    both = [jnp.matmul(frame, jnp.swapaxes(x * moved(model)[ids][:, :, None], 1, 2)) for x in (turn, move)]
    return jnp.concatenate(both, axis=1)


def _arm(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray) -> jax.Array:
    """From the point that MuJoCo's spatial vectors of the tree refer to."""
    return data.xipos[ids] - data.subtree_com[model.body_rootid[ids]]


def uncompensated(at: Site, step: SubStep, mass: jax.Array, place: jax.Array) -> jax.Array:
    """Generalised force `[nv]`: weight of loads that the model's `gravcomp` does not know; MuJoCo's grows with them.

    A controller or a counterweight carries the robot that it was made for.

    Args:
        mass: `[n]`, kg, of the loads on the site's bodies; place: `[n, 3]`, m from the bodies' centres of mass as they
            are with the loads, in the bodies' axes.
    """
    away = jnp.einsum("nij,nj->ni", jnp.reshape(step.data.xmat, (-1, 3, 3))[at.ids], place)
    share = step.model.body_gravcomp[at.ids] * mass
    return project(at.mj_model, step.data, at.ids, share[:, None] * step.model.opt.gravity, away)


def inertial_site(effect: "Effect", model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
    """Find the site of bodies whose inertials change.

    It refuses those whose mass matrix was compiled as diagonal, which an offset centre of mass would fill.
    """
    at = find(effect, model, timestep, substeps)
    for name, body in zip(at.names, at.ids, strict=True):
        if model.body_dofnum[body] > 1 and int(model.body_simple[body]) == 1:
            attributes.refuse_simple(model, int(body), f"{name}.{effect.name}")
    return at


def whole_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a specification's model with the same numbers, whose floating bodies' centres of mass may move.

    MuJoCo keeps the mass matrix of one at the origin of its body's frame as a diagonal, without room for more.
    """
    diagonal = [b for b in range(model.nbody) if floating(model, b) and model.body_simple[b]]
    if not diagonal:
        return model
    other = spec.copy()
    for body in (other.bodies[b] for b in diagonal):
        editing.explicit(other, body)
        body.ipos = np.array(body.ipos) + [ASIDE, 0, 0]
    new = other.compile()
    new.body_ipos[diagonal] = model.body_ipos[diagonal]
    mujoco.mj_setConst(new, mujoco.MjData(new))
    return new


def with_inertials(model: "mjx.Model", ids: np.ndarray, new: "dict[str, jax.Array]") -> "mjx.Model":
    """With inertial fields `{body_mass, ...: [n, ...]}` of bodies; for effects that are `inertial`."""
    return model.replace(**{field: getattr(model, field).at[ids].set(value) for field, value in new.items()})


def native(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> "Iterator[tuple[Any, int, dict[str, float]]]":
    """(body of the spec, its id, its values) for every place of an effect on bodies; "all": every one that can move."""
    compiled = spec.copy().compile()
    for place, own in values.items():
        for i, body in enumerate(spec.bodies):
            everywhere = place == "all" and compiled.body_weldid[i] != 0 and compiled.body_mass[i] > 0
            if everywhere or place in (body.name, f"body{i}"):
                yield body, i, own


def tilted(gravity: jax.Array, roll: jax.Array | float, pitch: jax.Array | float) -> jax.Array:
    """Gravity `[3]` in the frame of a robot turned by roll about the world's x, then by pitch about its y (rad)."""
    x, y, z = gravity
    # g' = R^T g, R = Ry(pitch) Rx(roll)
    x, z = jnp.cos(pitch) * x - jnp.sin(pitch) * z, jnp.sin(pitch) * x + jnp.cos(pitch) * z
    y, z = jnp.cos(roll) * y + jnp.sin(roll) * z, jnp.cos(roll) * z - jnp.sin(roll) * y
    return jnp.stack([x, y, z])
