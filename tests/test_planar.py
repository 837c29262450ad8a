"""The compiled step against MuJoCo's own, whose solver here goes on to rounding, not to its usual tolerance."""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from lt_lib.envs import planar
from lt_lib.envs.arena import Arena, physics_xml
from lt_lib.envs.layout import Rect, load_layout

SUBSTEPS = 6  # of physics a control step


def compiled_model(layout, changes=()):
    text = physics_xml(layout)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-12
    return model


def around_things(layout, model, n, seed=0):
    """States (pose, speed, command, slab, scout) beside boxes, at their corners and seams, and beside the scout."""
    rng = np.random.default_rng(seed)
    slab, scout, radius = rng.integers(0, len(layout.placements), n), layout.scout.sample(n, rng), layout.robot.radius
    boxes = planar.boxes(model, layout.slab_centres)
    centre, half = boxes[slab, rng.integers(0, boxes.shape[1], n)].transpose(1, 0, 2)[..., :2]
    across, side = rng.uniform(-1, 1, (n, 2)), rng.choice([-1, 1], (n, 2))
    place = side * (half + radius - rng.uniform(-0.003, 0.012, (n, 2)))  # at a corner
    place = np.where(np.arange(n)[:, None] % 3 == [[0, 1]], across * half, place)  # or along a face
    angle = rng.uniform(0, 2 * np.pi, n)
    gap = (2 * radius - rng.uniform(-0.003, 0.012, n)) * np.stack([np.cos(angle), np.sin(angle)])
    near = np.where(np.arange(n)[:, None] % 10 == 0, scout[:, :2] + gap.T, centre + place)
    pose = np.column_stack([near, rng.uniform(-3, 3, n)])
    speed = rng.normal(size=(n, 3)) * [0.3, 0.3, 1.0] * (rng.random((n, 1)) < 0.8)
    command = rng.uniform(-0.5, 0.5, (n, 3)) * [1, 1, 3]
    command[::7], speed[::7] = [0.2, -0.2, 0.1], 0.0  # the servos' forces are exactly their limits
    return pose, speed, command, slab, scout


def ours(layout, model, state, steps):
    """Pose and speed after physics steps."""
    pose, speed, command, slab, scout = (values.copy() for values in state)
    boxes, live = planar.boxes(model, layout.slab_centres), np.ones(len(pose), bool)
    planar.advance(pose, speed, np.zeros(len(pose)), command, live, slab, scout, boxes, planar.mechanics(model), steps)
    return pose, speed


def started(layout, model, state):
    """MuJoCo's batch in these states."""
    pose, speed, command, slab, scout = state
    batch = Batch(model, len(pose), nthread=1)
    for name, values in (("qpos", pose), ("qvel", speed), ("ctrl", command)):
        batch.bind(name)[:] = values
    batch.bind("mocap_pos")[:, :-1, :2], batch.bind("mocap_pos")[:, -1, :2] = layout.slab_centres[slab], scout[:, :2]
    return batch


def forwarded(layout, model, state):
    """MuJoCo's data (n) of each state, with contacts found and solved."""
    for pose, speed, command, slab, scout in zip(*state, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = pose, speed, command
        data.mocap_pos[:-1, :2], data.mocap_pos[-1, :2] = layout.slab_centres[slab], scout[:2]
        mujoco.mj_forward(model, data)
        yield data


@pytest.mark.parametrize("name", ["default", "half_friction", "leaking", "sampled_1"])
def test_steps_from_any_state_of_contact_equal_mujoco_s(name):
    layout = load_layout(name)
    model = compiled_model(layout)
    state = around_things(layout, model, 3000)
    for steps, exact in ((1, 1e-13), (SUBSTEPS, 1e-12)):
        batch, (pose, speed) = started(layout, model, state), ours(layout, model, state, steps)
        batch.step(None, nstep=steps)
        np.testing.assert_allclose(pose, batch.bind("qpos"), rtol=0, atol=exact)
        np.testing.assert_allclose(speed, batch.bind("qvel"), rtol=0, atol=100 * exact)


def test_those_states_have_what_a_wrong_step_would_miss():
    layout = load_layout("default")
    model = compiled_model(layout)
    state = around_things(layout, model, 600)
    touching = np.array([data.ncon for data in forwarded(layout, model, state)])
    assert (touching == 0).sum() > 50 and (touching == 1).sum() > 100 and (touching > 1).sum() > 50
    speed = ours(layout, model, state, 1)[1]
    scoutless = (*state[:4], state[4] + 50)
    assert (np.abs(ours(layout, model, scoutless, 1)[1] - speed) > 0.01).any(axis=1).sum() > 20
    for changes in (
        [('friction="1.0', 'friction="0.9')],
        [("forcerange", 'ctrlrange="-9 9" ctrllimited="true" forcelimited="false" forcerange')],
        [('condim="3"', 'condim="3" solref="0.04 1"')],
    ):
        other = compiled_model(layout, changes)
        assert (np.abs(ours(layout, other, state, 1)[1] - speed) > 1e-3).any(axis=1).sum() > 100


def test_every_number_comes_from_the_model():
    layout = load_layout("half_friction")
    model = compiled_model(
        layout,
        [
            ('mass="1.0"', 'mass="2.5"'),
            ('kv="100.0" forcerange="-20.0 20.0"', 'kv="60.0" forcerange="-7.0 11.0"'),
            ('kv="1.0"', 'kv="0.3" forcerange="-0.2 0.1"'),
            ('condim="3"', 'condim="3" solref="0.05 0.8" solimp="0.8 0.93 0.01 0.3 3"'),
            (f'timestep="{1 / 60}"', 'timestep="0.011"'),
        ],
    )
    state = around_things(layout, model, 2000)
    batch, (pose, speed) = started(layout, model, state), ours(layout, model, state, SUBSTEPS)
    batch.step(None, nstep=SUBSTEPS)
    np.testing.assert_allclose(pose, batch.bind("qpos"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(speed, batch.bind("qvel"), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["frictionless", "corridors_4_any"])
def test_without_friction_the_acceleration_solves_mujoco_s_problem_no_worse_than_mujoco_does(name):
    """There, rounding alone moves MuJoCo's answer, so ours is judged by the cost that both minimise."""
    layout = load_layout(name)
    model = compiled_model(layout)
    state, step = around_things(layout, model, 500), model.opt.timestep
    speed, near = ours(layout, model, state, 1)[1], []

    def cost(acceleration):
        short = np.minimum(data.efc_J.reshape(-1, 3) @ acceleration - data.efc_aref, 0.0)
        return (model.dof_M0 @ (acceleration - data.qacc_smooth) ** 2 + data.efc_D @ short**2) / 2

    for data, after in zip(forwarded(layout, model, state), speed, strict=True):
        limited = model.actuator_forcelimited & (np.abs(data.qfrc_actuator) >= model.actuator_forcerange[:, 1])
        implicit = model.dof_M0 - np.where(limited, 0.0, step * model.actuator_biasprm[:, 2])
        acceleration = (after - data.qvel) / step * implicit / model.dof_M0
        assert cost(acceleration) < cost(data.qacc) * (1 + 1e-12) + 1e-10
        near.append(np.abs(acceleration - data.qacc).max() < 1e-6)
    assert np.mean(near) > 0.9


def test_the_search_goes_on_until_no_edge_lets_go_any_more():
    """Pressed against the slab and barely touching a wall: a step of 1e-11 m/s2 there still frees two edges."""
    layout = load_layout("frictionless")
    model = compiled_model(layout)
    x0, _, _, y1 = layout.slab(0).bounds
    pose = [[x0 - layout.robot.radius + 8.34e-14, y1 - layout.robot.radius + 3.68856e-8, 8.75485e-6]]
    speed, command = [[-6e-15, -6.15394e-7, 3.0409970749e-6]], [[0.5, 4.31515e-6, -1.2945457e-5]]
    state = (np.array(pose), np.array(speed), np.array(command), np.zeros(1, np.int64), layout.scout.array[None])
    batch, (_, after) = started(layout, model, state), ours(layout, model, state, 1)
    batch.step()
    np.testing.assert_allclose(after, batch.bind("qvel"), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["default", "half_friction"])
def test_a_robot_pinned_or_sliding_for_400_control_steps_stays_where_mujoco_has_it(name):
    layout, n = load_layout(name), 24
    model, rng = compiled_model(layout), np.random.default_rng(0)
    arena = Arena(layout, n)
    x0, _, y0, y1 = layout.slab(0).bounds
    pose = np.column_stack([np.full(n, x0 - 0.2), rng.uniform(y0 + 0.16, y1 - 0.16, n), rng.uniform(-1, 1, n)])
    scout = layout.scout.sample(n, rng)
    arena.reset(np.ones(n, bool), pose, np.zeros(n, np.int64), scout)
    batch = started(layout, model, (pose, np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, np.int64), scout))
    action, pressed = np.tile([1.0, 0.0, 0.0], (n, 1)), 0
    for _ in range(400):
        drawn = (rng.random(n) < 0.05) & (np.arange(n) % 2 == 0)
        action[drawn] = rng.uniform([0, -1, -0.5], [1, 1, 0.5], (drawn.sum(), 3))
        action[1::2, 2] = -np.clip(arena.pose[1::2, 2], -1, 1)  # keeps the others against the slab
        cos, sin = np.cos(batch.bind("qpos")[:, 2]), np.sin(batch.bind("qpos")[:, 2])
        vx, vy, turn = action.T
        batch.bind("ctrl")[:] = np.column_stack([0.5 * (cos * vx - sin * vy), 0.5 * (sin * vx + cos * vy), 1.5 * turn])
        batch.step(None, nstep=SUBSTEPS)
        arena.step(action)
        pressed += arena.contact.sum()
        np.testing.assert_allclose(arena.pose, batch.bind("qpos"), rtol=0, atol=1e-10)
    assert pressed > 400 * n / 2


def test_without_friction_nobody_is_shot_through_a_wall():
    """MuJoCo's solver at its usual tolerance throws half of these robots out of the arena, at kilometres a second."""
    layout, n = load_layout("corridors_3"), 64
    arena, rng = Arena(layout, n), np.random.default_rng(0)
    pose = np.column_stack([np.full(n, -1.8), rng.uniform(-0.2, 0.2, n), np.zeros(n)])
    arena.reset(np.ones(n, bool), pose, np.zeros(n, np.int64), layout.scout.sample(n, rng))
    action = rng.uniform(-1, 1, (n, 3))
    for _ in range(300):
        before = arena.pose
        drawn = rng.random(n) < 0.05
        action[drawn] = rng.uniform([0, -1, -1], 1, (drawn.sum(), 3))
        arena.step(action)
        assert np.hypot(*(arena.pose - before)[:, :2].T).max() < 0.0708  # metres at full speed on both axes
        x, y = arena.pose[:, 0], arena.pose[:, 1]
        deepest = min(Rect(x=b.bounds[:2], y=b.bounds[2:]).distance(x, y).min() for b in layout.walls)
        assert deepest > layout.robot.radius - 0.02


def test_a_scene_is_stepped_alike_in_any_company():
    layout = load_layout("default")
    model = compiled_model(layout)
    state = around_things(layout, model, 200)
    pose, speed = ours(layout, model, state, SUBSTEPS)
    for rows in (slice(None, None, -1), slice(17, 18), slice(5, 150, 3)):
        some = ours(layout, model, tuple(np.ascontiguousarray(values[rows]) for values in state), SUBSTEPS)
        np.testing.assert_array_equal(some[0], pose[rows])
        np.testing.assert_array_equal(some[1], speed[rows])
