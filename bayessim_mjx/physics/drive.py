"""What acts on a world besides its command and its effects."""

import jax
from flax import struct

from bayessim_mjx.physics.controllers import Law


class Drive(struct.PyTreeNode):
    """What acts on a world besides its command, all optional.

    Attributes:
        force: `[nv]`, a generalised force of unknown origin.
        enabled: `[nu]`, 1 where the drive is on; 0: the actuator exerts no force at all (open leads), and a joint whose
            actuators are all off has no gravity compensation from them either (`actuatorgravcomp`).
        law: a controller between the command and the actuators; what it asks for is held over a timestep.
        active: `[effects]`, False where an effect is neutral in every world of the call, so that its hooks need not be
            computed (`physics.model.gated`).
    """

    force: jax.Array | None = None
    enabled: jax.Array | None = None
    law: Law | None = None
    active: jax.Array | None = None
