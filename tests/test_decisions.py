"""Richer decisions: arenas of several corridors, what one bit can tell, and one broadcast for many receivers."""

from itertools import product

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from lt_lib.beyond.corridors import ARENAS, corridor_layout
from lt_lib.beyond.deciders import MESSAGES, train_deciders
from lt_lib.beyond.decisions import DecisionProtocol, ceiling
from lt_lib.beyond.layouts import written
from lt_lib.beyond.rich import DEPTHS, MAT, RichScenes, draw_rich_scenes, mats, rich_layout
from lt_lib.beyond.tasks import ANSWERS, TASKS
from lt_lib.beyond.tasks.fixed_detour import COST
from lt_lib.beyond.variance import perfect_bank
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import NO_CORRIDOR, Layout, load_layout
from lt_lib.envs.materials import HAZARD
from lt_lib.envs.occlusion import occlusion, require_occlusion
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.perception.frames import free_poses
from lt_lib.perception.jepa import train_encoder
from lt_lib.pixels import episodes
from lt_lib.pixels.crew import arriving_executors, with_looks
from lt_lib.pixels.episodes import none_yet
from lt_lib.pixels.executor import Executor, FrozenExecutor, train_executor
from lt_lib.pixels.route import drawn, read_head, train_head
from lt_lib.settings.base import LAYOUTS, UserError
from lt_lib.settings.beyond import DeciderConfig
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.pixels import BankConfig, ExecutorConfig, HeadConfig, PixelsConfig
from lt_lib.settings.profiles import SECTIONS, validated
from lt_lib.store.runs import RunStore


def quiet(_: float) -> None:
    pass


@pytest.fixture(scope="module")
def four():
    return load_layout("corridors_4")


@pytest.fixture(scope="module")
def untrained():
    return train_encoder(EncoderConfig(frames=640, epochs=0.0), 0, report=quiet)


# --- arenas
@pytest.mark.parametrize("name", ARENAS)
def test_the_arenas_are_the_generator_s_and_show_every_slab_to_the_scout_alone(name):
    layout, count = corridor_layout(name), ARENAS[name][0]
    assert (LAYOUTS / f"{name}.yaml").read_text() == written(layout)
    one = layout.model_copy(update={"blocked": (1,)})
    seen = occlusion(one, FastCamera(one, 256))
    assert seen.navigator.shape == (count, count) and not seen.navigator.any()
    assert (seen.scout > 0).all() and (seen.scout.max() < 3 * seen.scout.min())


def test_any_number_of_corridors_is_blocked_but_never_all(four):
    assert four.placements == ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))
    np.testing.assert_array_equal(four.blocks, ~np.eye(4, dtype=bool)[::-1])
    assert load_layout("default").placements == ((0,), (1,))
    several = load_layout("corridors_4_any")
    assert [len(some) for some in several.placements] == [1] * 4 + [2] * 6 + [3] * 4
    assert len({*several.placements}) == 14 and not several.blocks.all(axis=1).any()


def test_a_copy_with_another_number_of_slabs_forgets_the_old_placements(four):
    assert four.slabs.shape == (4, 3, 4)
    one = four.model_copy(update={"blocked": (1,)})
    assert one.placements == ((0,), (1,), (2,), (3,)) and one.slabs.shape == (4, 1, 4)
    seen = HAZARD[FastCamera(one).frames(np.tile(one.scout.array, (4, 1)), np.arange(4), np.zeros((4, 2)))].sum((1, 2))
    together = HAZARD[FastCamera(four).frames(four.scout.array[None], np.zeros(1, int), np.zeros((1, 2)))].sum()
    assert together == seen[:3].sum()


@pytest.mark.parametrize("blocked", [(4,), (1, 5), (1, 1), (0,), ()])
def test_an_arena_without_a_free_corridor_is_refused_in_one_line(four, blocked):
    with pytest.raises(ValidationError, match="blocked"):
        Layout(**four.model_dump() | {"blocked": blocked})


def test_where_the_corridors_lie(four):
    mouths = [corridor.legs[0] for corridor in four.routes]
    x, y = np.array([[leg.x[0] + 0.1, sum(leg.y) / 2] for leg in mouths] + [[-3.0, 0.0]]).T
    np.testing.assert_array_equal(four.corridor_at(x, y), [0, 1, 2, 3, NO_CORRIDOR])


@pytest.mark.parametrize("name", ["corridors_4", "corridors_4_any"])
def test_several_slabs_are_drawn_as_mujoco_draws_them(name):
    rng, n, layout = np.random.default_rng(0), 60, load_layout(name)
    slab = rng.integers(0, len(layout.placements), n)
    other = free_poses(layout, slab, rng)
    pose = free_poses(layout, slab, rng, apart_from=other)
    fast, slow = (camera.frames(pose, slab, other[:, :2]) for camera in (FastCamera(layout), ReferenceCamera(layout)))
    assert (fast == slow).mean() > 0.998
    assert (HAZARD[fast].any((1, 2)) == HAZARD[slow].any((1, 2))).mean() > 0.98


@pytest.mark.parametrize("name", ["corridors_4", "corridors_4_any"])
def test_the_slabs_of_a_placement_are_solid_and_free_corridors_are_free(name):
    """A robot that pushes against every exit from beyond the barrier enters the free corridors alone."""
    layout = load_layout(name)
    placements, count = layout.blocks.shape
    n, arena = placements * count, Arena(layout, placements * count)
    slab, corridor = (axis.ravel() for axis in np.indices((placements, count)))
    pose = np.zeros((n, 3))
    pose[:, 0] = layout.barrier[1] + 0.6
    pose[:, 1] = [sum(layout.routes[side].slab.y) / 2 for side in corridor]
    pose[:, 2] = np.pi
    arena.reset(np.ones(n, bool), pose, slab, np.tile(layout.scout.array, (n, 1)))
    for _ in range(15):
        arena.step(np.tile([1.0, 0.0, 0.0], (n, 1)))
    blocked = layout.blocks[slab, corridor]
    np.testing.assert_array_equal(arena.corridor == corridor, ~blocked)
    np.testing.assert_array_equal(arena.contact, blocked)


def test_an_arena_in_which_the_navigator_sees_a_slab_is_refused(four):
    beyond = tuple(point.model_copy(update={"x": 3.0, "heading": 180.0}) for point in four.choice_points)
    bare = four.model_copy(update={"choice_points": beyond})
    with pytest.raises(UserError, match="the navigator sees the 1 slab") as error:
        require_occlusion(bare)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("corridors", [[2, 5], [4], ["2", 4], [2, 3]])
def test_impossible_numbers_of_corridors_are_refused_in_one_line(corridors):
    with pytest.raises(UserError, match="corridors") as error:
        validated(SECTIONS["corridors"], "corridors", corridors)
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="unknown layout 'corridors_5'"):
        DecisionProtocol.of({5: "corridors_5"}, {"executor": {"steps": 2}}, "cpu", 1)


def test_an_executor_has_a_command_per_corridor(untrained):
    config = ExecutorConfig(layout="corridors_3", steps=256, envs=4, rollout=32)
    weights = train_executor(config, 0, report=quiet, encoder=untrained)
    driver = FrozenExecutor(weights)
    assert driver.routes == 3
    actions = driver.mean_action(torch.zeros(3, 64), np.arange(3))
    assert actions.shape == (3, 3) and len({tuple(row) for row in actions.round(6)}) == 3
    assert Executor(3).mean[0].weight.shape[1] == 67


# --- what a bit can tell
def test_routes_are_drawn_with_their_probabilities():
    shares = np.tile([0.1, 0.2, 0.3, 0.4], (20_000, 1))
    counts = np.bincount(drawn(shares, np.random.default_rng(0)), minlength=4) / 20_000
    np.testing.assert_allclose(counts, shares[0], atol=0.015)
    two = np.random.default_rng(1).dirichlet([1, 1], 500)
    expected = np.random.default_rng(2).random(500) < two[:, 1]
    np.testing.assert_array_equal(drawn(two, np.random.default_rng(2)), expected)


@pytest.mark.parametrize(
    ("name", "bits"),
    [("corridors_3", 0), ("corridors_3", 1), ("corridors_6", 2), ("corridors_4_any", 1), ("default", 1)],
)
def test_the_ceiling_is_the_best_of_all_senders_and_readers(name, bits):
    blocks = load_layout(name).blocks
    routes, best = blocks.shape[1], 0.0
    for reader in product(range(routes), repeat=2**bits):  # a route for each value of the message
        right = ~blocks[:, list(reader)]  # (placements, values): the sender takes a value that is right, if one is
        best = max(best, right.any(axis=1).mean())
    assert ceiling(blocks, bits) == pytest.approx(best)
    assert ceiling(blocks, 5) == 1


@pytest.mark.parametrize(("content", "passes"), [("half", False), ("floor", False), ("state", True)])
def test_no_head_passes_the_ceiling_of_one_bit_unless_the_wire_leaks_more(content, passes, untrained):
    bank = perfect_bank("corridors_4", 64)
    config = HeadConfig(layout="corridors_4", content=content, episodes=6_000, minibatch=128)
    result = train_head(config, 0, report=quiet, bank=bank, encoder=untrained)
    share = result["optimal"][-500:].mean()
    assert (share > ceiling(load_layout("corridors_4").blocks, 1) + 0.06) == passes
    assert set(result["route"]) <= set(range(4)) and read_head(result).logits.out_features == 4


def test_messages_by_hand_say_what_they_claim(four):
    sender = Sender(four, None, np.zeros((4, 64, 64), np.uint8), np.zeros((4, 3)), np.zeros((4, 2)), np.arange(4))
    assert CONTENTS["half"](sender)[:, 0].tolist() == [0, 0, 1, 1]
    assert CONTENTS["state"](sender)[:, :2].tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]
    assert not CONTENTS["state"](sender)[:, 2:].any() and not CONTENTS["half"](sender)[:, 1:].any()


# --- one broadcast, many receivers
@pytest.fixture(scope="module")
def scenes() -> RichScenes:
    return draw_rich_scenes(rich_layout("default"), 600, np.random.default_rng(0))


def test_everything_in_a_scene_is_independent_of_everything_else(scenes):
    facts = np.column_stack([scenes.slab, scenes.depth, scenes.goal, scenes.company, scenes.detour])
    correlations = np.corrcoef(facts.T) - np.eye(5)
    assert np.abs(correlations).max() < 0.15
    assert scenes.depth.min() >= DEPTHS[0] and scenes.depth.max() <= DEPTHS[1]


def test_a_deeper_mat_shows_more_red_and_stands_before_its_own_exit(scenes):
    layout = rich_layout("default")
    assert layout.slab_height == MAT
    x0, x1, y0, y1 = mats(layout, scenes.slab, scenes.depth)[:, 0].T
    np.testing.assert_allclose(x1 - x0, scenes.depth)
    assert ((y0 > 0) == (scenes.slab == 0)).all() and (y1 - y0 > 0.5).all()
    red = (scenes.pictures[..., 0] > 150) & (scenes.pictures[..., 1] < 100)
    deep, flat = (red[pick].sum((1, 2)).mean() for pick in (scenes.depth > 1.2, scenes.depth < 0.4))
    assert deep > 1.5 * flat > 0


@pytest.mark.parametrize("task", ANSWERS, ids=lambda task: task.words)
def test_a_message_by_hand_decides_its_own_task(task, scenes):
    best = task.reward(scenes).argmax(axis=1)
    codes = task.bits(scenes) @ 2.0 ** np.arange(task.bits(scenes).shape[1])
    assert all(len(set(best[codes == code])) == 1 for code in set(codes)) and len(set(best)) > 1


def test_a_fixed_detour_needs_the_depth_s_one_bit_at_its_own_cost(scenes):
    task = TASKS["through or round at 0.6 m"]
    best = task.reward(scenes).argmax(axis=1)
    np.testing.assert_array_equal(best, (scenes.depth > COST).astype(int))
    np.testing.assert_array_equal(task.bits(scenes)[:, 0], best)
    assert task.own(scenes).shape == (len(scenes.depth), 0) and 0.3 < best.mean() < 0.9


def test_through_or_round_depends_on_the_receiver_s_own_detour(scenes):
    task = TASKS["through or round"]
    np.testing.assert_array_equal(task.reward(scenes).argmax(axis=1), (scenes.detour < scenes.depth).astype(int))
    np.testing.assert_array_equal(task.own(scenes)[:, 0], scenes.detour)


@pytest.mark.parametrize(
    ("task", "message", "low", "high"),
    [
        ("which goal", "'which goal' by hand", 0.95, 1.0),
        ("which goal", "nothing", 0.2, 0.45),
        ("is the side clear", "'which goal' by hand", 0.4, 0.6),
        ("which corridor", "latent", 0.8, 1.0),
    ],
)
def test_heads_learn_what_the_message_holds_and_nothing_else(task, message, low, high, untrained):
    sender = {name: value for name, value in untrained.items() if name.startswith("E.") or name in ("mean", "std")}
    config = DeciderConfig(task=task, message=message, scenes=2_048, episodes=6_000, heads=1)
    found = train_deciders(config, 0, report=quiet, sender=sender)
    assert low <= found["reward"].mean() <= high
    assert found["course"].shape == (1, 6_000) and found["reward"].shape == (1, 256)


def test_every_message_has_a_width_that_fits(scenes):
    few = scenes.take(slice(3))

    class Sixty:
        def latents(self, pictures):
            return np.zeros((len(pictures), 64))

    assert all(MESSAGES[name](few, Sixty()).shape[1] <= 64 for name in MESSAGES)


def at_every_slab(blocks):
    """A bank of one draw in which every blocked corridor is entered and its slab touched."""
    entered = np.broadcast_to(np.arange(blocks.shape[1]), (1, *blocks.shape))
    return {"success": ~blocks[None], "entered": entered, "contacts": blocks[None].astype(int)}


def test_executors_are_those_weights_that_arrive_most_often_and_another_seed_is_trained_where_few_do(tmp_path):
    protocol = DecisionProtocol.of({2: "corridors_2", 3: "corridors_3"}, {"executor": {"steps": 65_536}}, "cpu", 1)
    sizes = with_looks(protocol.protocols[3].sizes.executor)
    assert sizes.looks == (49_152, 57_344, 73_728, 81_920, 98_304) and sizes.steps == 98_304  # whole updates, half on
    shares = {(2, 0): (0.0, 0.5, 0.2, 0.1, 0.1), (2, 1): (0.0, 0.0, 0.3, 0.3, 0.3), (2, 2): (0.0, 0.4, 0.4, 0.6, 0.0)}
    shares[3, 0] = (0.2, 1.0, 1.0, 0.9, 0.0)
    asked = []

    class Store(RunStore):
        def fetch(self, runs, what):
            return [self.train(run) if what == "executors" else self.drive(run) for run in runs]

        def train(self, run):
            count = len(load_layout(run.config.layout).routes)
            asked.append((count, run.seed))
            return {f"{look}.share": s for look, s in zip(run.config.looks, shares[count, run.seed], strict=True)}

        def drive(self, run):
            blocks = load_layout(run.config.layout).blocks
            arrived = np.arange(10)[:, None, None] < 10 * run.inputs["executor"]["share"]
            return at_every_slab(blocks) | {"success": ~blocks & arrived}

    for each in protocol.protocols.values():
        object.__setattr__(each, "store", Store(tmp_path))
    found = protocol.executors({2: {"ours": {}}, 3: {"ours": {}}})
    assert {key: weights["share"] for key, weights in found.items()} == {2: 0.6, 3: 1.0}
    assert asked == [(2, 0), (3, 0), (2, 1), (2, 2)]
    asked.clear()
    DecisionProtocol({2: protocol.protocols[2]}).executors({2: {"ours": {}}})
    assert asked == [(2, 0), (2, 1), (2, 1), (2, 2)]  # the second seed beside the first, and then found kept


def test_an_executor_is_tried_as_its_pretraining_rewards_it_on_every_route_of_every_placement(monkeypatch):
    layout = load_layout("corridors_4_two")  # six placements, two free routes each

    def drive(arena, camera, encoder, executor, draws, slab, route, commit_step, horizon, report):
        assert arena.n == 3 * 6 * 4 and len({*zip(slab, route, map(tuple, draws.spawn), strict=True)}) == arena.n
        there = none_yet(len(slab))._replace(success=(slab == 0) & ~layout.blocks[slab, route], contacts=route + 0)
        return there._replace(entered=np.where(slab == 5, route, NO_CORRIDOR))

    monkeypatch.setattr(episodes, "drive", drive)
    monkeypatch.setattr(episodes, "FrozenEncoder", lambda *_: None)
    monkeypatch.setattr(episodes, "FrozenExecutor", lambda *_: None)
    config = BankConfig(layout="corridors_4_two", entries=3)
    found = episodes.roll_bank(config, 7, report=quiet, encoder={}, executor={})
    slab, route = np.nonzero(~layout.blocks)
    free = found["success"][:, ~layout.blocks]
    assert (free == (slab == 0)).all() and free.shape == (3, 12)
    assert episodes.arrival(found, layout.blocks) == (slab == 0).mean()
    slab, route = np.nonzero(layout.blocks)
    assert episodes.slab_reached(found, layout.blocks) == ((slab == 5) & (route > 0)).mean() > 0


def test_weights_that_never_reach_a_blocked_corridor_s_slab_are_not_taken(tmp_path):
    class Store(RunStore):
        def fetch(self, runs, what):
            if what == "executors":
                return [{f"{look}.w": np.full(1, run.seed) for look in run.config.looks} for run in runs]
            everywhere = at_every_slab(load_layout("default").blocks)
            never = everywhere | {"contacts": np.zeros((1, 2, 2))}
            return [everywhere if run.inputs["executor"]["w"][0] == 2 else never for run in runs]

    sizes = PixelsConfig(executor=ExecutorConfig(steps=16_384))
    assert arriving_executors(Store(tmp_path), {"": sizes}, {"": {}})[""]["w"] == 2
