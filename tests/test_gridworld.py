"""The gridworld against literal references: what is seen, what moves, what is read, what is learned."""

from fractions import Fraction
from itertools import pairwise
from math import floor

import numpy as np
import pytest
import torch
import yaml
from pydantic import ValidationError

from lt_lib import ppo
from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.comm.receiver import Receiver
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.gridworld import judgements, table_ppo
from lt_lib.gridworld.episodes import evaluate_grid, rerouted
from lt_lib.gridworld.map import GOAL_REWARD, HAZARD, HORIZON, PATCH, SLAB_REWARD, STEP_REWARD, WALL, Grid
from lt_lib.gridworld.mappo import Actor, Inputs, TableTeam, Team, batch, train_grid
from lt_lib.gridworld.patch_gates import measure_patch_gates, require_patch_gates
from lt_lib.gridworld.patches import random_walks, train_patch_encoder
from lt_lib.gridworld.protocol import GridProtocol
from lt_lib.gridworld.shadowcast import field_of_view
from lt_lib.gridworld.views import cells, pixels
from lt_lib.gridworld.walks import first_states, walk
from lt_lib.gridworld.wires import GRID_CONTENTS, contents_sent
from lt_lib.perception.gates import GateError
from lt_lib.perception.jepa import train_encoder
from lt_lib.preflight import check_inputs
from lt_lib.settings.base import UserError, layout_path
from lt_lib.settings.gridworld import (
    GridConfig,
    GridEvaluationConfig,
    GridworldConfig,
    PatchEncoderConfig,
    PatchGateConfig,
    PatchGates,
)
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.ppo import PpoConfig
from lt_lib.settings.profiles import explain
from lt_lib.store.runs import RunStore

GRID = Grid(load_layout("grid"))
EXACT = {"rtol": 1e-4, "atol": 1e-6}


def quiet(_: float) -> None:
    """A run's progress, unheard."""


@pytest.fixture(scope="module")
def encoder() -> dict[str, np.ndarray]:
    return train_patch_encoder(PatchEncoderConfig(frames=2048, epochs=0.0), 0, report=quiet)


# --- what is seen


def passes(opaque, origin, along, sign, slope, depth, side):
    """Whether a ray goes through all rows of cells before a depth; along an edge it keeps to the cells on one side."""
    for k in range(1, depth):
        at = slope * k + Fraction(1, 2)
        offset = floor(at) - 1 if at.denominator == 1 and side < 0 else floor(at)
        if blocked(opaque, origin, along, sign, k, offset):
            return False
    return True


def blocked(opaque, origin, along, sign, depth, offset):
    x, y = (sign * depth, offset) if along == 0 else (offset, sign * depth)
    x, y = origin[0] + x, origin[1] + y
    return not (0 <= x < opaque.shape[0] and 0 <= y < opaque.shape[1]) or opaque[x, y]


def seen_literally(opaque, origin, dx, dy):
    """A line of sight cell by cell: to an open cell's centre, to any part of a wall."""
    if (dx, dy) == (0, 0):
        return True
    for along in (0, 1):
        depth, offset = (dx, dy) if along == 0 else (dy, dx)
        sign, depth = (1 if depth > 0 else -1), abs(depth)
        if depth == 0 or abs(offset) > depth:
            continue
        slopes = [Fraction(offset, depth)]
        if blocked(opaque, origin, along, sign, depth, offset):
            low, high = (Fraction(2 * offset + side, 2 * depth) for side in (-1, 1))
            inner = {Fraction(2 * j + 1, 2 * k) for k in range(1, depth + 1) for j in range(-k - 1, k + 1)}
            edges = [low, *sorted(s for s in inner if low < s < high), high]
            slopes = [(a + b) / 2 for a, b in pairwise(edges)]
        rays = [(slope, side) for slope in slopes for side in (-1, 1) if abs(slope) < 1 or slope * side < 0]
        if any(abs(s) <= 1 and passes(opaque, origin, along, sign, s, depth, side) for s, side in rays):
            return True
    return False


@pytest.mark.parametrize("seed", range(3))
def test_the_shadow_cast_equals_a_literal_line_of_sight_in_random_mazes(seed):
    rng = np.random.default_rng(seed)
    opaque = np.pad(rng.random((9, 9)) < (0.15, 0.3, 0.45)[seed], 1, constant_values=True)
    for x, y in np.argwhere(~opaque)[:: 4 + seed]:
        seen = field_of_view(opaque, (int(x), int(y)), 7)
        for dx, dy in np.ndindex(seen.shape):
            cell = (x + dx - 7, y + dy - 7)
            if 0 <= cell[0] < opaque.shape[0] and 0 <= cell[1] < opaque.shape[1]:
                expected = seen_literally(opaque, (int(x), int(y)), dx - 7, dy - 7)
                assert seen[dx, dy] == expected, f"from {(x, y)} to {cell}"


def test_seeing_is_mutual_between_open_cells():
    opaque = GRID.wall
    seen = [field_of_view(opaque, tuple(cell), 7) for cell in GRID.cells]
    for i, a in enumerate(GRID.cells):
        for j, b in enumerate(GRID.cells):
            if (np.abs(a - b) <= 7).all():
                assert seen[i][tuple(7 + b - a)] == seen[j][tuple(7 + a - b)]


# --- the map


def test_the_placements_look_alike_from_every_cell_before_the_end_of_the_bend():
    before = GRID.centres[:, 0] < GRID.layout.barrier[0]
    assert before.sum() == 21 and set(GRID.spawn) == set(np.flatnonzero(before))
    for point in GRID.layout.choice_points:
        cell = GRID.at(point.x, point.y)
        np.testing.assert_array_equal(GRID.patches[cell, 0], GRID.patches[cell, 1])
    assert not GRID.revealing[before].any()
    peek = Grid(load_layout("grid_peek"))
    assert peek.revealing[[peek.at(point.x, point.y) for point in peek.layout.choice_points]].all()


def test_the_scout_sees_the_slab_from_each_of_its_posts_under_either_placement():
    assert len(GRID.posts) == 3
    assert ((GRID.patches[GRID.posts] == HAZARD).sum((2, 3)) == 1).all()


def test_moves_lead_one_cell_on_and_walls_hold():
    for p, (x, y) in enumerate(GRID.cells):
        for action, (dx, dy) in enumerate(((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))):
            there = p if GRID.wall[x + dx, y + dy] else GRID.index[x + dx, y + dy]
            assert GRID.following[p, action] == there


def test_patches_are_egocentric():
    p = GRID.at(*GRID.centres[GRID.spawn[0]])
    x, y = GRID.cells[p]
    for dx, dy in ((-1, 0), (0, -1), (1, 0)):
        assert (GRID.patches[p, 0, 7 + dx, 7 + dy] == WALL) == GRID.wall[x + dx, y + dy]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"barrier": [-1.4, 1.0]}, "off the grid of 0.5 m cells"),
        ({"spawn": {"x": 0.25, "y": 0.0, "heading": 0.0, "jitter": [0.1, 0.1, 0.0]}}, "spawn"),
        ({"goal": {"x": 1.25, "y": 1.4, "radius": 0.1}}, "goal"),
        ("walled", "cannot be reached from every spawn cell through the left corridor"),
    ],
)
def test_a_bad_layout_ends_in_one_line(tmp_path, change, words):
    text = yaml.safe_load(layout_path("grid").read_text())
    if change == "walled":
        text["corridors"]["left"]["legs"].pop(1)
        change = {}
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(text | change))
    with pytest.raises(UserError, match=words) as error:
        Grid(load_layout(str(path)))
    assert "\n" not in str(error.value)


def test_the_default_scene_is_refused_with_the_edge_that_is_off():
    with pytest.raises(UserError, match=r"corridors.left.legs\[0\].x has an edge at 0.6 m.*move it to 0.5 m"):
        Grid(load_layout("default"))


# --- walks


def test_walks_equal_a_literal_episode_loop():
    rng = np.random.default_rng(3)
    probs = rng.dirichlet(np.ones(5), (4, len(GRID.cells), 2))
    probs[..., 1] += 1  # drift towards the goal, so that episodes end in every way
    probs /= probs.sum(-1, keepdims=True)
    start = first_states(GRID, 6, np.random.default_rng(4))
    walks, last = walk(GRID, probs, start, 400, np.random.default_rng(5))
    uniform, states = np.random.default_rng(5).random((400, 6, 4)), [list(s) for s in zip(*start, strict=True)]
    ends = set()
    for t in range(400):
        for i, (cell, slab, post, clock) in enumerate(states):
            message = 0 if clock == 0 else post + 1
            action = int(np.searchsorted(np.cumsum(probs[message, cell, slab])[:-1], uniform[t, i, 0], side="right"))
            there, clock = GRID.following[cell, action], clock + 1
            goal, hit = GRID.goal[there], GRID.slab[slab, there]
            reward = GOAL_REWARD if goal else SLAB_REWARD if hit else STEP_REWARD
            got = tuple(values[t, i] for values in walks)
            assert got[:4] == (message, cell, slab, action) and got[5] == there
            assert got[4] == np.float32(reward) and got[6] == (goal or hit) and got[8] == goal and got[9] == clock
            assert got[7] == (goal or hit or clock == HORIZON)
            if got[7]:
                ends.add((bool(goal), bool(hit)))
                there, clock = GRID.spawn[int(uniform[t, i, 1] * len(GRID.spawn))], 0
                slab, post = int(uniform[t, i, 2] * 2), int(uniform[t, i, 3] * 3)
            states[i] = [there, slab, post, clock]
    assert ends == {(True, False), (False, True), (False, False)}
    np.testing.assert_array_equal(np.stack(last).T, states)


def test_random_walks_never_enter_the_slab():
    cells, slab, actions = random_walks(GRID, 200, 30, np.random.default_rng(0))
    assert not GRID.slab[slab[:, None], cells].any()
    moved = cells[:, 1:] != cells[:, :-1]
    assert (GRID.following[cells[:, :-1], actions[:, :-1]] == cells[:, 1:])[moved].all()


# --- the receiver


def a_receiver() -> Receiver:
    torch.manual_seed(0)
    receiver = Receiver(8, 6, 5)
    torch.nn.init.normal_(receiver.value.weight)
    return receiver


def test_the_receiver_is_softmax_attention_over_those_present():
    receiver, ego, wires = a_receiver(), torch.randn(4, 8), torch.randn(4, 3, 6)
    present = torch.tensor([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0]], dtype=torch.bool)
    pooled = receiver(ego, wires, present)
    for b in range(4):
        query, total, out = receiver.query(ego[b]), 0.0, torch.zeros(5)
        for n in range(3):
            if present[b, n]:
                weight = ((query * receiver.key(wires[b, n])).sum() / 5**0.5).exp()
                total, out = total + weight, out + weight * receiver.value(wires[b, n])
        torch.testing.assert_close(pooled[b], out / total if present[b].any() else out, **EXACT)


def test_the_order_of_senders_does_not_matter_and_an_absent_one_adds_exactly_nothing():
    receiver, ego, wires = a_receiver(), torch.randn(4, 8), torch.randn(4, 3, 6)
    order, everyone = torch.tensor([2, 0, 1]), torch.ones(4, 3, dtype=torch.bool)
    torch.testing.assert_close(receiver(ego, wires[:, order], everyone), receiver(ego, wires, everyone), **EXACT)
    two = everyone.clone()
    two[:, 1] = False
    louder = wires.clone()
    louder[:, 1] *= 1e6
    assert torch.equal(receiver(ego, louder, two), receiver(ego, wires, two))
    assert (receiver.attention(ego, louder, two)[:, 1] == 0).all()
    alone = receiver(ego, wires, torch.zeros_like(two))
    assert (alone == 0).all() and not alone.isnan().any()


def test_every_condition_starts_as_the_no_message_policy():
    torch.manual_seed(0)
    receiver = Receiver(8, 6, 5)
    assert (receiver(torch.randn(4, 8), torch.randn(4, 3, 6), torch.ones(4, 3, dtype=torch.bool)) == 0).all()


@pytest.mark.parametrize(("senders", "learns"), [(1, False), (3, True)])
def test_the_scores_learn_from_three_senders_and_not_from_one(senders, learns):
    receiver = a_receiver()
    receiver(torch.randn(4, 8), torch.randn(4, senders, 6), torch.ones(4, senders, dtype=torch.bool)).sum().backward()
    assert bool(receiver.query.weight.grad.abs().max() > 1e-6) == learns
    assert receiver.value.weight.grad.abs().max() > 1e-3


# --- the learner


def a_team(encoder, content: str) -> TableTeam:
    team = TableTeam(Inputs.of(GRID, cells(GRID, encoder), content))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        for parameter in team.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    return team


@pytest.mark.parametrize("content", ["latent", "raw", "oracle"])
def test_the_table_gives_the_gradients_of_the_plain_masked_update_over_both_robots(encoder, content):
    """The loss as MAPPO writes it, both robots' samples through the shared actor and the scout's masked."""
    team, rng, config = a_team(encoder, content), np.random.default_rng(1), PpoConfig()
    with torch.no_grad():
        log_probs, values = team.log_probs(), team.values()
    walks, _ = walk(GRID, log_probs.exp().numpy(), first_states(GRID, 8, rng), 40, rng)
    rows, sampled = batch(log_probs, values, walks, config)
    with torch.no_grad():
        team.actor.logits.bias += torch.tensor([0.5, -0.3, 0.1, 0.0, -0.4])  # some ratios beyond the clip
    optimiser = torch.optim.SGD(team.parameters(), lr=1.0)
    before = [p.detach().clone() for p in team.parameters()]
    once = config.model_copy(update={"epochs": 1})
    statistics = table_ppo.update(team, optimiser, rows, sampled, once, len(sampled.returns), rng)
    assert 0.02 < statistics.clipped < 0.98
    steps = [b - p.detach() for b, p in zip(before, team.parameters(), strict=True)]
    for parameter, value in zip(team.parameters(), before, strict=True):
        parameter.data.copy_(value)
    optimiser.zero_grad()
    masked_loss(team, sampled, config).backward()
    torch.nn.utils.clip_grad_norm_(team.parameters(), ppo.MAX_GRADIENT_NORM)
    for step, parameter in zip(steps, team.parameters(), strict=True):
        torch.testing.assert_close(step, torch.zeros_like(step) if parameter.grad is None else parameter.grad, **EXACT)


def masked_loss(team: Team, sampled: ppo.Batch, config: PpoConfig):
    n = len(sampled.returns)
    own = torch.cat([team.inputs.own[tuple(sampled.observations[:, 1:].T)], torch.randn(n, 64)])
    wires = torch.cat(
        [team.inputs.wires(sampled.observations), torch.zeros(n, team.inputs.wires(sampled.observations).shape[1])]
    )
    present = torch.cat([team.inputs.present[tuple(sampled.observations[:, :2].T)], torch.zeros(n, dtype=torch.bool)])
    mask = torch.cat([torch.ones(n), torch.zeros(n)])
    policy = torch.distributions.Categorical(logits=team.actor(own, wires[:, None], present[:, None]))
    actions = torch.cat([sampled.actions, torch.randint(0, 5, (n,))])
    old = torch.cat([sampled.log_probs, torch.full((n,), -1.6)])
    advantage = (sampled.advantages - sampled.advantages.mean()) / (sampled.advantages.std(correction=0) + 1e-8)
    surrogate = ppo.clipped_surrogate(
        (policy.log_prob(actions) - old).exp(), torch.cat([advantage, torch.randn(n)]), config.clip
    )
    states = sampled.observations[:, 1] * 2 + sampled.observations[:, 2]
    value_loss = (team.critic(states) - sampled.returns).square().mean()
    surrogate, entropy = ((x * mask).sum() / mask.sum() for x in (surrogate, policy.entropy()))
    return -surrogate + ppo.VALUE_COEFFICIENT * value_loss - config.entropy * entropy


def test_many_table_updates_end_where_the_shared_ppo_does(encoder):
    """Same minibatches, same Adam: per-sample autograd through the full receiver against the tables."""
    ends, config = [], PpoConfig()
    for by_table in (False, True):
        team, rng = a_team(encoder, "latent"), np.random.default_rng(1)
        optimiser = torch.optim.Adam(team.parameters(), lr=1e-3, eps=1e-5)
        with torch.no_grad():
            log_probs, values = team.log_probs(), team.values()
        walks, _ = walk(GRID, log_probs.exp().numpy(), first_states(GRID, 8, rng), 50, rng)
        rows, sampled = batch(log_probs, values, walks, config)
        if by_table:
            told = table_ppo.update(team, optimiser, rows, sampled, config, 64, rng)
        else:
            told = ppo.update(team, optimiser, sampled, config, 64, rng)
        ends.append((torch.cat([p.flatten() for p in team.parameters()]).detach(), torch.tensor(told)))
    for plain, table in zip(*ends, strict=True):
        torch.testing.assert_close(plain, table, rtol=1e-3, atol=1e-4)


def test_the_first_step_has_no_message_and_kinematic_ones_do_not_tell_the_placement(encoder):
    seen = cells(GRID, encoder)
    for content in GRID_CONTENTS:
        sent = contents_sent(GRID, seen, content)
        assert torch.equal(sent[:, 0], sent[:, 1]) == (content in ("floor", "position", "trajectory"))
    inputs = Inputs.of(GRID, seen, "latent")
    assert not inputs.present[0].any() and inputs.present[1:].all()
    assert (inputs.anchors[0] == 0).all() and (inputs.contents[0] == 0).all()


def test_training_is_the_same_twice_and_learns_to_arrive(encoder):
    config = GridConfig(content="oracle", steps=131_072, rollout=128)
    one, two = (train_grid(config, 1, report=quiet, encoder=encoder) for _ in range(2))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
    assert one["success"][:300].mean() < 0.15
    assert one["success"][-300:].mean() > 0.35
    assert one["ended"][-1] == len(one["success"]) == len(one["length"])


def test_corruption_leaves_a_deaf_policy_as_it_is_and_a_silent_wire_is_exactly_no_message(encoder):
    deaf = a_team(encoder, "latent").actor
    torch.nn.init.zeros_(deaf.receiver.value.weight)
    policy = {f"actor.{k}": v.numpy() for k, v in deaf.state_dict().items()}
    results = {
        wire: evaluate_grid(
            GridEvaluationConfig(content="latent", wire=wire, episodes=40),
            0,
            report=quiet,
            policy=policy,
            encoder=encoder,
        )
        for wire in CORRUPTIONS
    }
    for result in results.values():
        np.testing.assert_array_equal(result["greedy.cells"], results["intact"]["greedy.cells"])
        np.testing.assert_array_equal(result["sampled.cells"], results["intact"]["sampled.cells"])


def test_rerouting_is_entering_both_corridors():
    left, right = GRID.at(-1.25, 1.5), GRID.at(-1.25, -1.5)
    near, far = GRID.at(-1.75, 0.0), GRID.at(1.25, 0.0)
    paths = np.array([[near, left, near, right], [near, left, left, far], [near, near, near, near]])
    np.testing.assert_array_equal(rerouted(GRID, paths), [True, False, False])


# --- gates and refusals


def test_an_untrained_encoder_fails_the_gates(encoder):
    found = measure_patch_gates(PatchGateConfig(), 0, report=quiet, encoder=encoder)
    with pytest.raises(GateError, match="hazard-visible probe in unseen cells"):
        require_patch_gates(found, PatchGates())


def test_an_unknown_content_is_refused_before_anything_is_computed(tmp_path, encoder):
    protocol = GridProtocol(RunStore(tmp_path / "runs", 1), PatchEncoderConfig(), PatchGates(), GridConfig())
    with pytest.raises(UserError, match="unknown message content 'telepathy'; known: floor, position"):
        protocol.trained({"telepathy": 1}, encoder)
    assert not (tmp_path / "runs").exists()


def test_the_observation_has_225_cells():
    assert PATCH**2 == 225 and GRID.patches.shape[2:] == (15, 15)
    assert Actor(2 + 225).receiver.value.weight.shape == (64, 227)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"gridworld": {"layout": "default", "seeds": {}}}, "off the grid of 0.5 m cells"),
        (
            {"gridworld": {"layout": "grid_peek", "seeds": {}}},
            r"from the choice cell at \(-1.75, 0.5\) m the placements",
        ),
        ({"gridworld": {"seeds": {}}, "peek_layout": "nowhere"}, "unknown layout 'nowhere'"),
        ({"gridworld": {"seeds": {"telepathy": 5}}}, "gridworld.seeds: unknown message content 'telepathy'"),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(parameters, words):
    with pytest.raises(UserError, match=words) as error:
        check_inputs(parameters)
    assert "\n" not in str(error.value)


# --- judgements


def played(success: dict[str, float], rerouted: float = 0.0) -> dict[str, dict]:
    """A policy's 100 episodes under every wire condition; what is not named succeeds as with the wire intact."""
    shares = dict.fromkeys(CORRUPTIONS, success["intact"]) | success
    return {
        wire: {"sampled.success": np.arange(100) < 100 * share, "sampled.rerouted": np.arange(100) < 100 * rerouted}
        for wire, share in shares.items()
    }


def test_who_falls_who_peeks_and_who_must_not_change_are_told_apart():
    destroyed = [wire for wire in CORRUPTIONS if wire != "intact"]
    reads = played({"intact": 1.0} | dict.fromkeys(destroyed, 0.4))
    peeks, deaf = played({"intact": 1.0}, rerouted=0.5), played({"intact": 0.5})
    success, rerouted = (judgements.sampled([reads, reads, peeks], what) for what in ("success", "rerouted"))
    assert judgements.returned(*success)["value"] == "2 of 3"
    assert judgements.peeks(rerouted[0], *success[1:]).tolist() == [False, False, True]
    assert judgements.unchanged(*judgements.changes({"position": [deaf, deaf]}))["value"] == "all"
    moved = played({"intact": 0.5, "wire_zeroed": 0.8})
    assert judgements.unchanged(*judgements.changes({"position": [moved, moved]}))["value"] == "not all"
    # an empty content is what it was under three of the wires, so only the zeroed wire is compared
    assert len(judgements.changes({"floor": [deaf], "position": [deaf]})) == 1 + len(destroyed)


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_the_value_projection_starts_where_its_gain_says(gain):
    weight = Actor(66, gain).receiver.value.weight.detach()
    assert torch.linalg.svdvals(weight) == pytest.approx(gain, abs=1e-5)


def test_rendered_frames_are_those_of_the_camera_and_equal_at_the_choice_cells():
    untrained = train_encoder(EncoderConfig(frames=512, epochs=0.0), 0, report=quiet)
    views = pixels(GRID, untrained)
    camera, layout = FastCamera(GRID.layout), GRID.layout
    for place in (0, 17, 40):
        pose = np.array([[*GRID.centres[place], 0.0]])
        np.testing.assert_array_equal(views.own[place, 1], camera.frames(pose, [1], layout.scout.array[None, :2])[0])
    for point in layout.choice_points:
        cell = GRID.at(point.x, point.y)
        np.testing.assert_array_equal(views.own[cell, 0], views.own[cell, 1])
    assert (views.posts[:, 0] != views.posts[:, 1]).any((1, 2)).all()
    assert Inputs.of(GRID, views, "latent").own.shape == (len(GRID.cells), 2, 64)


def test_an_unknown_setting_inside_a_section_is_named_with_its_neighbours():
    with pytest.raises(ValidationError) as error:
        GridworldConfig(policy={"step": 3}, seeds={})
    told = explain(error.value, "gridworld", GridworldConfig)
    assert told.startswith(
        "gridworld.policy.step: unknown parameter; gridworld.policy has envs, lr, minibatch, ppo, rollout, steps"
    )
