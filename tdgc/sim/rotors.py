"""Rotor inertia of the joints' motors, which Bullet's joints lack.

Behind its gear a rotor resists the acceleration of its joint and nothing else: it adds its inertia
J to the joint's entry in the diagonal of the mass matrix, and J q'^2 / 2 to the kinetic energy.
Bullet knows the inertia of links only. So J is added there twice about the joint's axis: to the
link that the joint moves and to its parent, which turns at w about that axis. Their energy,
J (q' + w)^2 / 2 + J w^2 / 2, exceeds the rotor's by E = J w (q' + w). The torques that this excess
takes follow from Lagrange's equations, and are given back a joint control later.

That is a Jacobi iteration of the equations of motion. With J in both links it converges for any J;
in the moved link alone it would not, where the trunk is light.

Bullet keeps a link's inertia about its principal axes, so J goes to the one nearest to the joint's
axis. That is exact where they coincide, as in the shipped robot, and wrong where they are tilted.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def excess_momentum(body_rate: Array, q: Array, qd: Array) -> tuple[Array, Array]:
    """Derivatives of E / J with respect to the velocities and to the angles.

    Args:
        body_rate: (n, 3) rad/s, angular velocity of the trunk in the body frame.
        q, qd: (n, 12) rad and rad/s.

    Returns:
        The first, with respect to ``qd`` and ``body_rate``, (n, 15) rad/s. The second as the terms
        of Lagrange's equations that they lead to, (n, 15) rad^2/s^2: -dE/dq of the joints, and the
        trunk's momentum times its angular velocity, since the body frame rotates.
    """
    hip, thigh, calf = qd[:, 0::3], qd[:, 1::3], qd[:, 2::3]
    roll, pitch, yaw = body_rate.T[..., None]
    angle = q[:, 0::3]
    cos, sin = np.cos(angle), np.sin(angle)
    # w of the three joints. Thigh and calf turn about the hip's leftward axis.
    of_thigh = cos * pitch + sin * yaw
    of_calf = of_thigh + thigh
    momentum, force = np.empty((len(q), 15)), np.zeros((len(q), 15))
    momentum[:, 0:12:3] = roll
    momentum[:, 1:12:3] = of_thigh + calf + 2.0 * of_calf  # w of the calf changes with the thigh
    momentum[:, 2:12:3] = of_calf
    leftward = thigh + calf + 2.0 * (of_thigh + of_calf)
    x, y, z = momentum[:, 12:].T  # of the trunk
    x[:] = (hip + 2.0 * roll).sum(axis=1)
    y[:], z[:] = (cos * leftward).sum(axis=1), (sin * leftward).sum(axis=1)
    force[:, 0:12:3] = -leftward * (cos * yaw - sin * pitch)
    # The body's rate times the trunk's momentum; np.cross takes half as long as all of the rest.
    a, b, c = body_rate.T
    force[:, 12], force[:, 13], force[:, 14] = b * z - c * y, c * x - a * z, a * y - b * x
    return momentum, force
