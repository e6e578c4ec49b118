"""Rotor inertia of the joints' motors, which Bullet's joints lack.

Behind its gear a rotor resists the acceleration of its joint and nothing else: it adds its inertia
J to the joint's entry in the diagonal of the mass matrix, and J q'^2 / 2 to the kinetic energy.
Bullet knows the inertia of links only. So J is added there twice about the joint's axis: to the
link that the joint moves and to its parent, which turns at w about that axis. Their energy,
J (q' + w)^2 / 2 + J w^2 / 2, exceeds the rotor's by E = J w (q' + w). The torques that this excess
takes follow from Lagrange's equations, and are given back a joint control later.

That is a Jacobi iteration of the equations of motion. With J in both links it converges for any J;
in the moved link alone it would not, where the trunk is light.

A contact is part of these equations, but Bullet solves it once, with too much inertia: it stops
J in both links of a joint, and what is given back a joint control later would throw the foot off
again. The contact should have pushed less, by the force that has the same torques about the leg's
joints as what is given back. So that force is taken from the contact afterwards, with
``force_on_calf``. Where the contact persists, as in stance, this changes no motion: the ground
pushes that much more.

Bullet keeps a link's inertia about its principal axes, so J goes to the one nearest to the joint's
axis. That is exact where they coincide, as in the shipped robot, and wrong where they are tilted.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.geometry import Geometry

Array = NDArray[np.float64]

# Of the thigh's length: levers shorter than that are taken to be as long. Chosen by hand.
_SHORTEST = 0.1


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


def force_on_calf(
    geometry: Geometry, leg: int, angles: Array, point: Array, torque: Array
) -> Array:
    """Force on a calf that has given torques about the joints of its leg.

    Where a leg is nearly straight or level, that would take a very large force; then a smaller one
    is returned.

    Args:
        geometry: the robot's geometry.
        leg: 0-3.
        angles: (3,) rad, of hip, thigh and calf.
        point: (3,) m in the trunk's frame, where the force acts.
        torque: (3,) N m, about hip, thigh and calf.

    Returns:
        (3,) N in the trunk's frame.
    """
    (hip, thigh, _), (x, y, z), (about_hip, about_thigh, about_calf) = (
        part.tolist() for part in (angles, point, torque)
    )
    cos, sin = math.cos(hip), math.sin(hip)
    # The point from the hip joint, in a frame that turns with the hip, and from the calf joint.
    x, y = x - float(geometry.hips[leg, 0]), y - float(geometry.hips[leg, 1])
    left, down = cos * y + sin * z, sin * y - cos * z
    calf_x = x + geometry.thigh * math.sin(thigh)
    calf_down = down - geometry.thigh * math.cos(thigh)
    shortest = _SHORTEST * geometry.thigh
    area = down * calf_x - x * calf_down
    area = math.copysign(max(abs(area), shortest * geometry.calf), area)
    forward = (x * about_calf - calf_x * about_thigh) / area
    downward = (down * about_calf - calf_down * about_thigh) / area
    leftward = (about_hip + left * downward) / math.copysign(max(abs(down), shortest), down)
    return np.array([forward, cos * leftward + sin * downward, sin * leftward - cos * downward])
