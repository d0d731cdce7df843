"""What equality constraints (closed loops, coupled joints) tell of a model's joints, by its geometry alone."""

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
# rad or m: of what is solved in doubles, whose derivatives have the cube root of their precision. No state is known
# better
NUDGE = float(np.finfo(float).eps ** (1 / 3))


class Loops:
    """The equality constraints of a model; positions are qpos `[nq]`, changes of them `[nv]`.

    Args:
        model: with hinges and slides wherever joints are not measured.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)

    def at(self, qpos: Array) -> tuple[Array, Array]:
        """Return (derivatives `[m, nv]` of the active constraints by the position, their values `[m]`)."""
        model, data = self.model, self.data
        if not model.neq:
            return np.zeros((0, model.nv)), np.zeros(0)
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        own = np.flatnonzero(data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
        J = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(J, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        else:
            J = data.efc_J.reshape(data.nefc, model.nv)
        return J[own].copy(), data.efc_pos[own].copy()

    def closed(self, qpos: Array, fixed: NDArray[np.bool_]) -> Array:
        """Return a position with the constraints met by the joints that are not `fixed` `[nv]`, from anywhere."""
        if not self.model.neq or fixed.all():
            return np.array(qpos, float)

        def there(change: Array) -> tuple[Array, Array]:
            return self.at(self._moved(qpos, change, ~fixed))

        none = np.zeros(int((~fixed).sum()))
        if not len(there(none)[1]):
            return np.array(qpos, float)
        best = least_squares(lambda x: there(x)[1], none, jac=lambda x: there(x)[0][:, ~fixed]).x
        return self._moved(qpos, best, ~fixed)

    def followed(
        self, qpos: Array, qvel: Array, sd: Array, seen: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array] | None:
        """Return the motion (qpos `[T, nq]`, qvel `[T, nv]`, sd `[T, 2 nv]`) of all joints by those that are seen.

        Row by row, each from the one before, so that a loop stays the way round in which it was assembled.

        Args:
            qpos, qvel: `[T, ..]`, of the seen joints; the others' first row is where they are looked for.
            sd: `[2 nv]`, standard deviations of measured positions and velocities; seen: `[nv]` bool.

        Returns:
            None where constraints do not tell it in every row.
        """
        if not self.model.neq or not seen.any():
            return None
        nv, other = self.model.nv, self.model.jnt_qposadr[self.model.dof_jntid[~seen]]
        noise = np.where(np.tile(seen, 2), sd, 0.0).reshape(2, nv)
        now, rows = self.closed(qpos[0], seen), []
        for row, speed in zip(qpos, np.where(seen, qvel, 0.0), strict=True):
            now = np.where(np.isin(np.arange(self.model.nq), other), now, row)
            found = self._near(now, seen)
            if found is None:
                return None
            now, by_seen = found
            rows.append((now, speed + by_seen @ speed, np.hypot(noise, noise @ np.abs(by_seen).T).ravel()))
        return tuple(map(np.array, zip(*rows, strict=True)))  # type: ignore[return-value]

    def followers(self, poses: Array, first: NDArray[np.bool_]) -> dict[int, int]:
        """{dof: another that it moves with at the same ratio in all poses `[n, nq]`}, one of `first` if there is.

        A gear, a belt, a finger's second joint: a force at one of both moves the robot as one at the other does.
        """
        if not self.model.neq:
            return {}
        derivatives = [self.at(pose)[0] for pose in poses]
        ways = np.array([np.eye(self.model.nv) - np.linalg.pinv(J) @ J for J in derivatives])  # what they leave free
        order, out = np.argsort(~first, kind="stable").tolist(), dict[int, int]()
        for k, lead in enumerate(order):
            own = ways[:, lead]
            size = np.sum(own**2, axis=1)
            if lead in out or size.min() < NUDGE:
                continue
            for other in order[k + 1 :]:
                ratio = np.median(np.sum(ways[:, other] * own, axis=1) / size)
                if abs(ratio) > NUDGE and np.abs(ways[:, other] - ratio * own).max() < NUDGE:
                    out[other] = lead
        return out

    def _near(self, qpos: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array] | None:
        """Return `closed` by Newton's method, and derivatives `[nv, nv]` of others by the seen; None where it fails."""
        step, last = np.full(1, np.inf), np.inf
        while np.abs(step).max() >= NUDGE:
            J, off = self.at(qpos)
            if np.linalg.matrix_rank(J[:, ~seen]) < (~seen).sum():
                return None  # joints stay free
            inverse = np.linalg.pinv(J[:, ~seen])
            step = -inverse @ off
            if (size := np.abs(step).max()) >= last:
                return None
            qpos, last = self._moved(qpos, step, ~seen), size
        out = np.zeros((self.model.nv, self.model.nv))
        out[np.ix_(~seen, seen)] = -inverse @ J[:, seen]
        return qpos, out

    def _moved(self, qpos: Array, change: Array, which: NDArray[np.bool_]) -> Array:
        there, whole = np.array(qpos, float), np.zeros(self.model.nv)
        whole[which] = change
        mujoco.mj_integratePos(self.model, there, whole, 1.0)
        return there
