"""The scene against MuJoCo and against slow, literal computations; and one clear line for every impossible layout."""

import heapq

import mujoco
import numpy as np
import pytest
import torch
import yaml
from PIL import Image, ImageSequence
from pydantic import ValidationError

from lt_lib.envs.arena import HORIZON, Arena, physics_xml
from lt_lib.envs.camera import FastCamera, colours, network_input
from lt_lib.envs.fidelity import agreement
from lt_lib.envs.geodesic import MARGIN, RESOLUTION, RouteDistance
from lt_lib.envs.layout import NO_CORRIDOR, Layout, Robot, load_layout
from lt_lib.envs.materials import HAZARD, INDEX
from lt_lib.envs.occlusion import occlusion, require_occlusion, sight_map
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.envs.warp_camera import WarpCamera
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.frames import free_poses
from lt_lib.pixels.episodes import draw_scenes, drive
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.pixels.film import Take
from lt_lib.pixels.pair import FIRST, LAST, _said, save_pair
from lt_lib.settings.base import UserError, layout_path

DEFAULT = yaml.safe_load(layout_path("default").read_text())
SUBSTEPS = 6  # of physics a control step: 60 Hz over 10 Hz


@pytest.fixture(scope="module")
def layout():
    return load_layout("default")


def random_scenes(layout, n, seed=0):
    """Poses of two robots that touch nothing: eyes (n, 3), slabs (n,), others (n, 2)."""
    rng = np.random.default_rng(seed)
    slabs = rng.integers(0, 2, n)
    others = free_poses(layout, slabs, rng)
    return free_poses(layout, slabs, rng, apart_from=others), slabs, others[:, :2]


# --- cameras


@pytest.mark.parametrize(("slab_height", "poses"), [(1.0, 1000), (0.15, 200)])
def test_fast_camera_agrees_with_mujoco_at_random_poses(slab_height, poses):
    layout = Layout(**DEFAULT | {"slab_height": slab_height})  # the lower slab shows its top
    reference = ReferenceCamera(layout)
    found = agreement(FastCamera(layout), reference, *random_scenes(layout, poses))
    reference.close()
    assert found.pixels >= 0.999
    assert found.flags == 1
    assert found.grey_levels <= 2
    assert found.frames == poses


def test_a_ray_exactly_along_an_axis_is_drawn_like_its_neighbours(layout):
    eye, other = np.array([[-3.0, 0.0, 0.0]]), np.array([[2.3, 0.0]])  # one pixel: its ray has no y component at all
    assert FastCamera(layout, 1).frames(eye, [0], other).item() == INDEX["barrier_x"]


def test_network_input_is_the_colours_over_255(layout):
    frames = FastCamera(layout).frames(*random_scenes(layout, 50))
    inputs = network_input(frames)
    assert inputs.dtype == np.float32
    np.testing.assert_array_equal(inputs, colours(frames).astype(np.float32) / np.float32(255))


def test_slab_is_hidden_from_the_whole_near_side_and_fills_a_quarter_of_the_scout_s_view(layout):
    reference = ReferenceCamera(layout, 512)
    seen = occlusion(layout, reference)
    reference.close()
    assert seen.navigator.shape == (2, 2)
    assert not seen.navigator.any()
    assert seen.scout.min() >= 512**2 / 4
    assert all(np.nanmax(sight_map(layout, slab, spacing=0.25).pixels) == 0 for slab in (0, 1))


def test_leaking_layout_loads_leaks_a_few_pixels_and_is_refused():
    leaking = load_layout("leaking")
    reference = ReferenceCamera(leaking, 512)
    assert 0 < occlusion(leaking, reference).navigator.max() <= 100
    reference.close()
    assert np.nanmax(sight_map(leaking, 0, spacing=0.25).pixels) > 0
    with pytest.raises(UserError, match=r"^layout leaking: the navigator sees the left slab from choice_points\[0\]"):
        require_occlusion(leaking)


def test_fast_camera_agrees_with_mujoco_warp(layout):
    eyes, slabs, others = random_scenes(layout, 48, 5)
    ours, theirs = FastCamera(layout).frames(eyes, slabs, others), WarpCamera(layout, 48).frames(eyes, slabs, others)
    assert (ours == theirs).mean() > 0.999
    np.testing.assert_array_equal(HAZARD[ours].any(axis=(1, 2)), HAZARD[theirs].any(axis=(1, 2)))
    assert len(np.unique(theirs)) > 8


# --- physics


def start(layout, n, seed=0):
    """n arenas with navigators all over the place, slabs and scouts included."""
    arena, rng = Arena(layout, n), np.random.default_rng(seed)
    eyes, slabs, _ = random_scenes(layout, n, seed)
    arena.reset(np.ones(n, bool), eyes, slabs, layout.scout.sample(n, rng))
    return arena


def test_arena_steps_equal_a_plain_mj_step_loop_to_rounding(layout):
    arena, actions = start(layout, 16), np.random.default_rng(1).uniform(-1.5, 1.5, (40, 16, 3))
    first, paths = arena.pose, []
    for action in actions:
        arena.step(action)
        paths.append(arena.pose)
    model = mujoco.MjModel.from_xml_string(physics_xml(layout))
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-12  # MuJoCo's own solver goes to rounding, too
    for i in range(arena.n):
        data = mujoco.MjData(model)
        data.qpos[:] = first[i]
        x0, x1, y0, y1 = layout.slab(int(arena.slab[i])).bounds
        data.mocap_pos[:, :2] = ((x0 + x1) / 2, (y0 + y1) / 2), arena.scout[i, :2]
        for action, path in zip(actions[:, i], paths, strict=True):
            vx, vy, turn = np.clip(action, -1, 1)
            cos, sin = np.cos(data.qpos[2]), np.sin(data.qpos[2])
            data.ctrl[:] = 0.5 * (cos * vx - sin * vy), 0.5 * (sin * vx + cos * vy), 1.5 * turn
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
            np.testing.assert_allclose(path[i], data.qpos, rtol=0, atol=1e-12)


def test_a_scene_does_not_depend_on_what_is_stepped_beside_it(layout):
    many, actions = start(layout, 33), np.random.default_rng(2).uniform(-1, 1, (30, 33, 3))
    alone = Arena(layout, 1)
    alone.reset(np.ones(1, bool), many.pose[20:21], many.slab[20:21], many.scout[20:21])
    for action in actions:
        many.step(action)
        alone.step(action[20:21])
        np.testing.assert_array_equal(alone.pose[0], many.pose[20])


def test_scenes_that_are_not_live_stand_still_and_the_others_go_on_as_ever(layout):
    some, every = start(layout, 16), start(layout, 16)
    live, first = np.arange(16) % 3 > 0, some.pose
    for action in np.random.default_rng(3).uniform(-1, 1, (30, 16, 3)):
        some.step(action, live)
        every.step(action)
    np.testing.assert_array_equal(some.pose[~live], first[~live])
    np.testing.assert_array_equal(some.pose[live], every.pose[live])
    assert (every.pose[~live] != first[~live]).any(axis=1).all()


def test_reset_forgets_the_episode_before_and_touches_no_other_scene(layout):
    begin = np.array([[0.76, 0.56, 0.3], [-3.0, 1.0, 0.0]])  # the first starts in a corner of slab and wall
    scout, action = np.tile(layout.scout.array, (2, 1)), np.ones((2, 3))
    used, fresh = Arena(layout, 2), Arena(layout, 2)
    for arena in (used, fresh):
        arena.reset(np.ones(2, bool), begin, np.zeros(2, int), scout)
    for _ in range(20):
        used.step(action)
    other = used.pose[1]
    used.reset(np.array([True, False]), begin, np.zeros(2, int), scout)
    np.testing.assert_array_equal(used.pose, [begin[0], other])
    for _ in range(20):
        used.step(action)
        fresh.step(action)
        np.testing.assert_array_equal(used.pose[0], fresh.pose[0])


def test_full_commands_move_5_cm_and_turn_0_15_rad_a_step_in_the_body_s_frame(layout):
    arena = Arena(layout, 2)
    pose = np.array([[4.0, 0.0, 0.5], [4.0, 0.0, 0.5]])
    arena.reset(np.ones(2, bool), pose, np.zeros(2, int), np.tile(layout.scout.array, (2, 1)))
    for _ in range(5):
        before = arena.pose
        arena.step(np.array([[3.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))  # clipped to 1
    moved = arena.pose - before
    np.testing.assert_allclose(moved[0], [0.05 * np.cos(0.5), 0.05 * np.sin(0.5), 0], atol=1e-4)
    np.testing.assert_allclose(moved[1], [0, 0, 0.15], atol=1e-3)


def test_walls_slab_and_scout_stop_the_navigator_and_only_the_slab_counts_as_contact(layout):
    # into the left slab, the same way with the slab elsewhere, into the scout, into the outer wall
    poses = np.array([[0.4, 0.4, 0.0], [0.4, 0.4, 0.0], [3.2, 0.0, np.pi], [6.0, 2.0, 0.0]])
    arena = Arena(layout, 4)
    arena.reset(np.ones(4, bool), poses, np.array([0, 1, 1, 1]), np.tile(layout.scout.array, (4, 1)))
    assert not arena.contact.any()
    for _ in range(40):
        arena.step(np.tile([1.0, 0.0, 0.0], (4, 1)))
    radius = layout.robot.radius
    assert arena.contact.tolist() == [True, False, False, False]
    assert arena.corridor.tolist() == [0, NO_CORRIDOR, NO_CORRIDOR, NO_CORRIDOR]
    stopped_at = [layout.slab(0).bounds[0] - radius, layout.scout.x + 2 * radius, layout.arena.x[1] - radius]
    np.testing.assert_allclose(arena.pose[[0, 2, 3], 0], stopped_at, atol=0.01)
    assert arena.pose[1, 0] > layout.slab(0).bounds[1]  # nothing was in its way


class Blind(FrozenEncoder):
    """An encoder that sees nothing."""

    def __init__(self):
        pass

    def latent(self, frames):
        return torch.zeros(len(frames), 64)


class Straight(FrozenExecutor):
    """Full speed ahead for route 0, standing still for route 1."""

    def __init__(self):
        pass

    def mean_action(self, latent, route):
        return np.column_stack([1.0 - route, np.zeros((len(route), 2))])


def test_friction_holds_back_a_robot_that_presses_against_a_wall_and_only_it():
    travelled = {}
    for name in ("frictionless", "half_friction", "default"):
        arena = Arena(load_layout(name), 2)
        pose = np.array([[-3.0, -2.34, 0.0], [-3.0, 0.0, 0.0]])  # beside the right wall, and in the open
        arena.reset(np.ones(2, bool), pose, np.zeros(2, np.int64), np.tile([2.3, 0.0, np.pi], (2, 1)))
        for _ in range(6):
            heading = arena.pose[:, 2]
            world = np.stack([np.full(2, 0.6), np.array([-0.8, 0.0])], axis=1)  # forward and into the wall
            body = [
                np.cos(heading) * world[:, 0] + np.sin(heading) * world[:, 1],
                np.cos(heading) * world[:, 1] - np.sin(heading) * world[:, 0],
            ]
            arena.step(np.column_stack([*body, np.zeros(2)]))
        travelled[name] = arena.pose[:, 0] + 3.0
    beside, free = np.array(list(travelled.values())).T  # (layouts,) metres each
    np.testing.assert_allclose(free, free[0], atol=1e-6)
    assert abs(beside[0] - free[0]) < 0.02 and beside[1:].max() < 0.8 * free[0]
    with pytest.raises(ValidationError, match="greater than or equal to 0"):
        Robot(radius=0.15, height=0.4, friction=-1.0)


def test_arrival_slab_contact_and_time_out_are_told_apart(layout):
    draws = draw_scenes(layout, 3, np.random.default_rng(0))
    draws.spawn[:] = [[4.5, 0.0, 0.0], [0.4, 0.4, 0.0], [4.5, 0.0, 0.0]]
    slab, route = np.array([0, 0, 0]), np.array([0, 0, 1])
    ended = drive(Arena(layout, 2), FastCamera(layout), Blind(), Straight(), draws, slab, route, 0, HORIZON)
    assert ended.success.tolist() == [True, False, False]
    metres = layout.goal.x - layout.goal.radius - 4.5
    assert abs(ended.length[0] - metres / 0.05) <= 2
    assert ended.length[1:].tolist() == [HORIZON, HORIZON]
    assert ended.contacts[0] == ended.contacts[2] == 0
    assert HORIZON - 20 < ended.contacts[1] < HORIZON
    assert ended.entered.tolist() == [NO_CORRIDOR, 0, NO_CORRIDOR]
    assert ended.returns[0] == 1
    assert ended.returns[1] == pytest.approx(-0.01 * ended.contacts[1])


# --- walking distance


def slow_distances(layout, side):
    """Walking distance to the goal from every grid point, by Dijkstra's algorithm as in a textbook."""
    xs, ys = (np.arange(low, high + RESOLUTION / 2, RESOLUTION) for low, high in (layout.arena.x, layout.arena.y))
    clearance = layout.robot.radius + MARGIN

    def place(cell):
        return xs[cell[0]], ys[cell[1]]

    def walkable(cell):
        if not (0 <= cell[0] < len(xs) and 0 <= cell[1] < len(ys)):
            return False
        x, y = place(cell)
        if layout.routes[1 - side].contains(x, y):
            return False
        for x0, x1, y0, y1 in (wall.bounds for wall in layout.walls):
            nearest = min(max(x, x0), x1), min(max(y, y0), y1)
            if np.hypot(x - nearest[0], y - nearest[1]) <= clearance:
                return False
        return np.hypot(x - layout.scout.x, y - layout.scout.y) > 2 * clearance

    goal = abs(xs - layout.goal.x).argmin(), abs(ys - layout.goal.y).argmin()
    best, queue, done = {goal: 0.0}, [(0.0, goal)], set()
    while queue:
        length, cell = heapq.heappop(queue)
        if cell in done:
            continue
        done.add(cell)
        for dx, dy in [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]:
            after, further = (cell[0] + dx, cell[1] + dy), length + RESOLUTION * np.hypot(dx, dy)
            if further < best.get(after, np.inf) and walkable(after):
                best[after] = further
                heapq.heappush(queue, (further, after))
    return {place(cell): length for cell, length in best.items()}


def test_route_distance_equals_a_slow_search_on_a_small_layout():
    small = Layout(**DEFAULT | {
        "arena": {"x": [-2.5, 3.0], "y": [-2.0, 2.0]},
        "spawn": {"x": -2.1, "y": 0.0, "heading": 0.0, "jitter": [0.0, 0.0, 0.0]},
        "goal": {"x": 2.5, "y": 0.9, "radius": 0.3},
    })  # fmt: skip
    quick = RouteDistance(small)
    for side in (0, 1):
        slow = slow_distances(small, side)
        cells = np.array(list(slow))
        np.testing.assert_allclose(quick(cells, np.full(len(cells), side)), list(slow.values()), atol=1e-9)
    spawn = np.tile(small.spawn.array[:2], (2, 1))
    left, right = quick(spawn, np.array([0, 1]))
    assert left < right  # the goal stands on the left


# --- bad layouts


def changed(**changes):
    """The default layout with some values replaced: {'corridors.left.slab': ...}; None removes the key."""
    layout = yaml.safe_load(yaml.safe_dump(DEFAULT)) | {"name": "mine"}
    for path, value in changes.items():
        *parents, key = path.split(".")
        node = layout
        for parent in parents:
            node = node[parent]
        if value is None:
            del node[key]
        else:
            node[key] = value
    return layout


NARROW = [{"x": [-1.5, 0.6], "y": [1.15, 1.4]}, *DEFAULT["corridors"]["left"]["legs"][1:]]
BAD = {
    "narrow": (
        {"corridors.left.legs": NARROW},
        r"corridors.left.legs\[0\] is 0.25 m wide, narrower than the robot \(0.30 m\)",
    ),
    "scout in a wall": ({"scout.x": 1.1, "scout.y": 1.0}, r"scout at \(1.1, 1.0\) stands in a wall"),
    "choice point in a wall": (
        {"choice_points": [{"x": -1.0, "y": 0.0, "heading": 0.0}] * 2},
        r"choice_points\[0\] at .* stands in a wall",
    ),
    "goal outside": ({"goal.x": 9.0}, r"goal at \(9.0, 0.0\) stands in a wall"),
    "unknown key": ({"slabs": 3}, "slabs: "),
    "missing key": ({"camera.fov": None}, "camera.fov: "),
    "text for a number": ({"robot.radius": "wide"}, "robot.radius: "),
    "upside down": ({"barrier": [1.2, -1.5]}, "barrier: .*low < high"),
    "triple": ({"barrier": [1.2, 1.5, 2.0]}, "barrier: "),
    "number for an interval": ({"barrier": 1.2}, "barrier: "),
    "nothing in an interval": ({"barrier": [None, 1.2]}, "barrier.0: "),
    "no list": ({"corridors.left.legs": 3}, "corridors.left.legs: "),
    "slabs of two sizes": ({"corridors.right.slab.x": [0.9, 1.8]}, "the slab must have the same size in all corridors"),
    "camera over the walls": ({"camera.height": 1.5}, "camera.height 1.5 m must be below"),
    "scout looks away": ({"scout.heading": 0.0}, "the scout cannot see the slab in the left corridor"),
    "scout sees one side": ({"scout.heading": 135.0}, "the scout cannot see the slab in the right corridor"),
    "navigator sees it": (
        {"choice_points": [{"x": -1.8, "y": -1.25, "heading": 0.0}, {"x": 0.3, "y": 0.4, "heading": 0.0}]},
        r"the navigator sees the left slab from choice_points\[1\] \(\d+ of 262144 pixels\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_an_impossible_layout_gives_one_clear_line(case, tmp_path):
    changes, line = BAD[case]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(changed(**changes)))
    with pytest.raises(UserError, match=rf"^layout mine(\.yaml)?: {line}") as caught:
        require_occlusion(load_layout(str(path)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "- 1", "a: [", "just words", "slab_height: 1\nslab_height: 2"])
def test_a_file_that_is_no_layout_gives_one_clear_line(text, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="^layout mine.yaml: ") as caught:
        load_layout(str(path))
    assert "\n" not in str(caught.value)


def test_an_unknown_layout_is_named_with_the_known_ones():
    with pytest.raises(
        UserError,
        match=r"^unknown layout 'defualt'; known: corridors_2, .*, default, frictionless",
    ):
        load_layout("defualt")


def test_a_blocked_route_is_named(layout):
    walled = Layout(**changed(**{"corridors.left.legs": DEFAULT["corridors"]["left"]["legs"][:2]}))
    with pytest.raises(
        UserError, match="^layout mine: the goal cannot be reached from the spawn through the left corridor"
    ):
        RouteDistance(walled)


def test_the_pair_holds_the_choice_and_says_how_each_episode_ends(layout, tmp_path):
    path = np.column_stack([np.linspace(-3.0, 6.0, 60), np.zeros(60), np.zeros(60)])
    stuck = np.tile(path[20], (HORIZON + 1, 1))
    takes = {
        "the scout sends its latent": Take(path, layout.scout.array, 0, 1),
        "the scout sends nothing": Take(stuck, layout.scout.array, 0, 0),
    }
    first, second = takes.values()
    assert _said(layout, first, 2, 2) == "0.2 s: the navigator chooses the right corridor"
    assert _said(layout, first, HORIZON, 2) == "goal after 6 s"
    assert _said(layout, second, HORIZON, 2) == "stuck: time-out after 60 s"
    with Image.open(save_pair(layout, takes, 2, tmp_path / "pair.gif")) as film:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert durations[0] == FIRST and durations[-1] == LAST and len(durations) > 10
