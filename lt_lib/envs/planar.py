"""MuJoCo's step of the arena, compiled for its three degrees of freedom: the same equations, solved to rounding.

A sphere on two slides and a hinge, driven by velocity servos, touches upright boxes and a standing sphere. Scenes are
stepped one by one, so none depends on its neighbours. MuJoCo's own solver stops at a tolerance. Without friction it has
no solution then: contacts are so stiff (1e11 kg) that it shoots a robot in a corner out of the arena.

Triples are over the degrees of freedom, x and y (metres) and heading (radians). A contact's friction cone is a pyramid
of four edges, the rows of MuJoCo's constraint Jacobian, collected in `edges` (E, 7).
"""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lt_lib.envs.compiled import compiled

_EDGES = 4  # of a contact's pyramid, two along either tangent
_INSIDE = mujoco.mjMINVAL  # metres; a centre nearer to a box than this lies inside it
_EXACT = 1e-7  # m/s2, rad/s2: the last Newton step is smaller. Without friction, rounding alone makes it 1e-8
_X, _Y, _TURN, _TARGET, _WEIGHT, _SHORT, _CHANGE = range(7)  # columns of `edges`: see `_push`, and the search below
_STEPS = 100  # at most, of Newton's method and of the search along each of its directions; a handful is usual


class Mechanics(NamedTuple):
    """What the equations take from a model."""

    timestep: float  # seconds
    inertia: tuple[float, float, float]  # kg, kg, kg m2
    gain: tuple[float, float, float]  # N, N, Nm per unit of command
    bias: tuple[float, float, float]  # N, N, Nm per unit of speed
    lowest: tuple[float, float, float]  # N, N, Nm: the force that a servo can exert
    highest: tuple[float, float, float]
    radius: float  # metres
    height: float  # metres, of the navigator's centre
    scout_radius: float
    scout_height: float
    friction: float  # Coulomb's coefficient, or the smallest that MuJoCo admits
    stiffness: float  # 1/s2, reference acceleration of a contact per depth
    damping: float  # 1/s, and per speed
    inverse_mass: float  # 1/kg, MuJoCo's estimate of what an edge pushes against
    impedance: tuple[float, float, float, float, float]  # MuJoCo's solimp


def mechanics(model: mujoco.MjModel) -> Mechanics:
    """The numbers of a model made by `physics_xml`, those of contacts from MuJoCo's own first contact."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)  # all bodies start at the origin, so they touch
    stiffness, damping, impedance, _ = data.efc_KBIP[0]
    bounds = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, [-np.inf, np.inf])
    navigator, scout = (model.geom(int(model.body(name).geomadr[0])) for name in ("navigator", "scout"))
    return Mechanics(
        timestep=model.opt.timestep,
        inertia=tuple(model.dof_M0.tolist()),
        gain=tuple(model.actuator_gainprm[:, 0].tolist()),
        bias=tuple(model.actuator_biasprm[:, 2].tolist()),
        lowest=tuple(bounds[:, 0].tolist()),
        highest=tuple(bounds[:, 1].tolist()),
        radius=float(navigator.size[0]),
        height=float(data.geom_xpos[navigator.id, 2]),
        scout_radius=float(scout.size[0]),
        scout_height=float(data.geom_xpos[scout.id, 2]),
        friction=float(data.contact[0].friction[0]),
        stiffness=float(stiffness),
        damping=float(damping),
        inverse_mass=float(data.efc_R[0] * impedance / (1 - impedance)),
        impedance=tuple(data.contact[0].solimp.tolist()),
    )


def boxes(
    model: mujoco.MjModel, slabs: Float[np.ndarray, "placements slabs 2"]
) -> Float[np.ndarray, "placements boxes 2 3"]:
    """Centre and half size of every box, metres, with the slabs' bodies at these places (x, y)."""
    box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    every = np.tile(np.stack([model.geom_pos[box], model.geom_size[box]], axis=1), (len(slabs), 1, 1, 1))
    every[:, model.geom_bodyid[box] > 0, 0, :2] += slabs  # the walls belong to the world, body 0
    return every


@compiled()
def _apart(dx, dy, dz, hx, hy, hz):
    """Unit vector from a box of these half sizes to a point, and its distance (metres), as in mjraw_SphereBox.

    (dx, dy, dz) leads from the box's centre to the point. Where that is inside, the vector leaves through the nearest
    face and the distance is negative. A box without size is the centre of a sphere, as in mjraw_SphereSphere.
    """
    x, y, z = dx - min(max(dx, -hx), hx), dy - min(max(dy, -hy), hy), dz - min(max(dz, -hz), hz)
    distance = np.sqrt(x * x + y * y + z * z)
    if distance > _INSIDE:
        return x / distance, y / distance, z / distance, distance
    to_x, to_y, to_z = hx - abs(dx), hy - abs(dy), hz - abs(dz)
    if to_x <= min(to_y, to_z):
        return (1.0 if dx > 0 else -1.0), 0.0, 0.0, -to_x
    if to_y <= to_z:
        return 0.0, (1.0 if dy > 0 else -1.0), 0.0, -to_y
    return 0.0, 0.0, (1.0 if dz > 0 else -1.0), -to_z


@compiled()
def _impedance(depth, solimp):
    """How hard a contact of this depth (metres) is, between 0 and 1: MuJoCo's getimpedance."""
    low, high, width, middle, power = solimp
    x = depth / width
    if x >= 1:
        return high
    if x <= middle:
        return low + (high - low) * middle * (x / middle) ** power
    return low + (high - low) * (1 - (1 - middle) * ((1 - x) / (1 - middle)) ** power)


@compiled()
def _push(nx, ny, nz, depth, speed, m, edges, count):
    """Adds the edges of a contact along a unit normal that points at the navigator; returns how many there are then.

    An edge is a row of MuJoCo's constraint Jacobian (x, y, turn), the acceleration along it that the contact asks for
    (efc_aref), and what it costs to fall short of that (efc_D). Mirrors mju_makeFrame, mj_instantiateContact,
    mj_makeImpedance and mj_referenceConstraint.
    """
    # the first tangent is y or, close to a normal along y, z without its part along the normal; z is never felt
    flat = abs(ny) < 0.5
    along = ny if flat else nz
    ax, ay, az = -along * nx, flat - along * ny, (not flat) - along * nz
    length = np.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    bx, by = ny * az - nz * ay, nz * ax - nx * az
    arm = depth / 2 - m.radius  # the force acts in the middle of the overlap
    hardness = _impedance(depth, m.impedance)
    for edge in range(_EDGES):
        slope = m.friction if edge % 2 else -m.friction
        x, y = nx + slope * (ax if edge < 2 else bx), ny + slope * (ay if edge < 2 else by)
        turn = arm * (nx * y - ny * x)
        parting = x * speed[0] + y * speed[1] + turn * speed[2]
        edges[count, _X], edges[count, _Y], edges[count, _TURN] = x, y, turn
        edges[count, _TARGET] = m.stiffness * hardness * depth - m.damping * parting
        edges[count, _WEIGHT] = hardness / ((1 - hardness) * m.inverse_mass)
        count += 1
    return count


@compiled()
def _touch(x, y, speed, boxes, scout_x, scout_y, m, edges):
    """Collects the edges of everything that the navigator overlaps; returns how many."""
    count = 0
    for k in range(boxes.shape[0]):
        dx, dy = x - boxes[k, 0, 0], y - boxes[k, 0, 1]
        hx, hy = boxes[k, 1, 0], boxes[k, 1, 1]
        if abs(dx) < hx + m.radius and abs(dy) < hy + m.radius:  # rules out most boxes without a root
            dz, hz = m.height - boxes[k, 0, 2], boxes[k, 1, 2]
            nx, ny, nz, distance = _apart(dx, dy, dz, hx, hy, hz)
            if distance < m.radius:
                count = _push(nx, ny, nz, m.radius - distance, speed, m, edges, count)
    nx, ny, nz, distance = _apart(x - scout_x, y - scout_y, m.height - m.scout_height, 0.0, 0.0, 0.0)
    if distance < m.radius + m.scout_radius:
        count = _push(nx, ny, nz, m.radius + m.scout_radius - distance, speed, m, edges, count)
    return count


@compiled()
def _direction(free, found, edges, count, m):
    """Newton's direction (3 numbers) from `found`, and how far each edge falls short there: mj_solNewton's Hessian."""
    h00, h11, h22 = m.inertia
    h10, h20, h21 = 0.0, 0.0, 0.0
    g0, g1, g2 = h00 * (found[0] - free[0]), h11 * (found[1] - free[1]), h22 * (found[2] - free[2])
    for e in range(count):
        x, y, turn = edges[e, _X], edges[e, _Y], edges[e, _TURN]
        short = x * found[0] + y * found[1] + turn * found[2] - edges[e, _TARGET]
        edges[e, _SHORT] = short
        if short < 0:
            w = edges[e, _WEIGHT]
            g0, g1, g2 = g0 + w * short * x, g1 + w * short * y, g2 + w * short * turn
            h00, h10, h11 = h00 + w * x * x, h10 + w * x * y, h11 + w * y * y
            h20, h21, h22 = h20 + w * x * turn, h21 + w * y * turn, h22 + w * turn * turn
    l10, l20 = h10 / h00, h20 / h00  # LDL' of the Hessian, then both substitutions
    d1 = h11 - l10 * h10
    l21 = (h21 - l20 * h10) / d1
    d2 = h22 - l20 * h20 - l21 * l21 * d1
    z1 = l10 * g0 - g1
    s2 = (l20 * g0 - g2 - l21 * z1) / d2
    s1 = z1 / d1 - l21 * s2
    return -g0 / h00 - l10 * s1 - l20 * s2, s1, s2


@compiled()
def _reach(slope, curvature, edges, count):
    """How far to go in a direction to the least cost: the root of its derivative, which rises piecewise linearly.

    The cost of leaving the free acceleration has this slope at the start, and curvature; every edge adds its own.
    """
    near, far, reach = 0.0, np.inf, 1.0
    for _ in range(_STEPS):
        first, second = slope + reach * curvature, curvature
        for e in range(count):
            change = edges[e, _CHANGE]
            short = edges[e, _SHORT] + reach * change
            if short < 0:
                first += edges[e, _WEIGHT] * change * short
                second += edges[e, _WEIGHT] * change * change
        near, far = (reach, far) if first < 0 else (near, reach)
        newton = reach - first / second
        if newton == reach:
            break
        reach = newton if near <= newton <= far else (near + far) / 2
    return reach


@compiled()
def _constrained(free, edges, count, m):
    """The acceleration under contact (3 numbers): Newton's method with an exact search, as MuJoCo's but to rounding.

    It has the least cost, half of the sum over inertia (acceleration - free)^2 and, of every edge that falls short of
    its target, over weight (edge . acceleration - target)^2.
    """
    f0, f1, f2 = free
    i0, i1, i2 = m.inertia
    for _ in range(_STEPS):
        s0, s1, s2 = _direction(free, (f0, f1, f2), edges, count, m)
        steady = True
        for e in range(count):
            edges[e, _CHANGE] = edges[e, _X] * s0 + edges[e, _Y] * s1 + edges[e, _TURN] * s2
            steady &= (edges[e, _SHORT] < 0) == (edges[e, _SHORT] + edges[e, _CHANGE] < 0)
        reach = 1.0  # exact where the same edges fall short
        if not steady:
            slope = i0 * (f0 - free[0]) * s0 + i1 * (f1 - free[1]) * s1 + i2 * (f2 - free[2]) * s2
            reach = _reach(slope, i0 * s0 * s0 + i1 * s1 * s1 + i2 * s2 * s2, edges, count)
        f0, f1, f2 = f0 + reach * s0, f1 + reach * s1, f2 + reach * s2
        if steady and max(abs(s0), abs(s1), abs(s2)) < _EXACT:
            break
    return f0, f1, f2


@compiled()
def _free(command, speed, d, m):
    """Acceleration of one degree of freedom without contact, and the inertia that the integrator gives it.

    A servo's damping is integrated implicitly, unless it is at its limit: there it no longer answers to the speed.
    """
    force = m.gain[d] * command + m.bias[d] * speed
    if force <= m.lowest[d] or force >= m.highest[d]:
        return min(max(force, m.lowest[d]), m.highest[d]) / m.inertia[d], m.inertia[d]
    return force / m.inertia[d], m.inertia[d] - m.timestep * m.bias[d]


@compiled(boundscheck=True)  # arrays of another size are an IndexError
def advance(qpos, qvel, time, command, live, slab, scout, boxes, m, steps):
    """Takes physics steps in place, in the scenes that are live: mj_step with the integrator implicitfast.

    qpos, qvel, command (n, 3);  time (n,), seconds;  live (n,);  slab (n,): placement;  scout (n, 3)
    boxes (placements, B, 2, 3): centre and half size, metres
    """
    edges = np.empty((_EDGES * (boxes.shape[1] + 1), 7))
    i0, i1, i2 = m.inertia
    for i in range(qpos.shape[0]):
        if not live[i]:
            continue
        x, y, heading = qpos[i, 0], qpos[i, 1], qpos[i, 2]
        v0, v1, v2 = qvel[i, 0], qvel[i, 1], qvel[i, 2]
        c0, c1, c2 = command[i, 0], command[i, 1], command[i, 2]
        around, scout_x, scout_y = boxes[slab[i]], scout[i, 0], scout[i, 1]
        for _ in range(steps):
            a0, d0 = _free(c0, v0, 0, m)
            a1, d1 = _free(c1, v1, 1, m)
            a2, d2 = _free(c2, v2, 2, m)
            count = _touch(x, y, (v0, v1, v2), around, scout_x, scout_y, m, edges)
            if count:
                a0, a1, a2 = _constrained((a0, a1, a2), edges, count, m)
            v0, v1, v2 = v0 + m.timestep * i0 / d0 * a0, v1 + m.timestep * i1 / d1 * a1, v2 + m.timestep * i2 / d2 * a2
            x, y, heading = x + m.timestep * v0, y + m.timestep * v1, heading + m.timestep * v2
            time[i] += m.timestep
        qpos[i, 0], qpos[i, 1], qpos[i, 2] = x, y, heading
        qvel[i, 0], qvel[i, 1], qvel[i, 2] = v0, v1, v2
