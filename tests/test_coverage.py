"""Noise against its closed forms, the navigator without a route and its episodes against slow literal loops."""

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.stats import spearmanr

from lt_lib.comm.channel import ANCHOR
from lt_lib.envs.arena import Arena
from lt_lib.envs.layout import NO_CORRIDOR, load_layout
from lt_lib.perception.encoder import Encoder, FrozenEncoder, Predictor
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.report.claims import load_claims
from lt_lib.settings.base import UserError
from lt_lib.settings.velocity import Boost, Configuration, NavigatorConfig, PretrainingConfig, RolloutConfig
from lt_lib.velocity import judgements
from lt_lib.velocity.coverage import TABLE_2, WINDOWED, Imposed, explore, play, started
from lt_lib.velocity.diagnostics import command_error, message_error
from lt_lib.velocity.navigator import LATERAL, Errand, Navigator, Scouts, annealed, stopped, train_navigator
from lt_lib.velocity.noise import Ar1
from lt_lib.velocity.transfer import BOOSTS, DIRECT, require_looks

LAYOUT = load_layout("default")
FOUR_SDS = 4.0  # of a Monte-Carlo estimate


def quiet(_: float) -> None:
    """A run's progress, unheard."""


@pytest.fixture(scope="module")
def weights() -> dict[str, np.ndarray]:
    """A random encoder, normalised to nothing: enough where no perception is asked for."""
    torch.manual_seed(0)
    parts = {"E": Encoder(), "P": Predictor()}
    arrays = {f"{p}.{k}": v.numpy() for p, m in parts.items() for k, v in m.state_dict().items()}
    return arrays | {"mean": np.zeros(64, np.float32), "std": np.ones(64, np.float32)}


@pytest.fixture(scope="module")
def encoder(weights) -> FrozenEncoder:
    return FrozenEncoder(weights)


def driver(forward: float, across: float) -> Navigator:
    """A navigator that commands one velocity whatever it sees."""
    navigator = Navigator().requires_grad_(False)
    navigator.velocity[-1].weight.zero_()
    navigator.velocity[-1].bias.copy_(torch.tensor([forward, across, 0.0]))
    return navigator


# --- noise
@pytest.mark.parametrize("tau", [0.0, 3.0, 30.0])
def test_ar1_has_unit_variance_from_its_first_step_on_and_the_autocorrelation_of_its_correlation_time(tau):
    n, lag = 40_000, 5
    chains = Ar1(np.full(n, tau), np.random.default_rng(0))
    x = np.stack([chains.step(np.full(n, t == 0)) for t in range(lag + 1)])
    closed_form = np.exp(-lag / tau) if tau else 0.0
    assert np.abs(x.var(axis=1) - 1).max() < FOUR_SDS * np.sqrt(2 / n)
    assert abs((x[0] * x[lag]).mean() - closed_form) < FOUR_SDS * np.sqrt(2 / n)


def test_a_fresh_chain_forgets_and_a_negative_correlation_time_is_refused():
    n = 40_000
    chains = Ar1(np.full(n, 1000.0), np.random.default_rng(1))
    before, fresh = chains.step(np.ones(n, bool)), np.arange(n) < n // 2
    after = chains.step(fresh)
    assert abs((before * after)[fresh].mean()) < FOUR_SDS / np.sqrt(n / 2)
    assert (before * after)[~fresh].mean() > 0.95
    with pytest.raises(ValueError, match="must not be negative"):
        Ar1(np.array([-1.0]), np.random.default_rng(0))


def test_noise_is_imposed_on_the_lateral_axis_within_the_window_and_nowhere_else():
    mean, std = torch.tensor([[0.1, 0.2, 0.3]]).repeat(4, 1), torch.tensor([0.5, 0.6, 0.7])
    window, own = np.array([40, 40, 0, 0]), np.array([0.0, 1.0, 0.0, 1.0])
    imposed = Imposed(np.full(4, 2.0), np.zeros(4), window, own)
    action = explore(mean, std, imposed, np.full(4, 1.5), 10, np.random.default_rng(0))
    theirs = np.random.default_rng(0).standard_normal((4, 3)) * std.numpy() * own[:, None]
    theirs[:2, LATERAL] = 2.0 * 1.5
    np.testing.assert_allclose(action, mean.numpy() + theirs, atol=1e-6)
    np.testing.assert_allclose(action[2], mean[2], atol=1e-7)  # deterministic, outside the window


# --- the navigator
def test_every_condition_starts_as_the_navigator_without_a_message_and_can_leave_it():
    navigator, latent = Navigator(), torch.randn(5, 64)
    silent, spoken = (navigator.mean(latent, wire) for wire in (torch.zeros(5, 66), torch.randn(5, 66)))
    assert torch.equal(silent, spoken)
    navigator.mean(latent, torch.randn(5, 66)).sum().backward()
    assert navigator.message.weight.grad.abs().min() > 0


def test_the_boost_widens_the_lateral_axis_alone_and_only_the_critic_sees_the_slab():
    navigator = Navigator()
    observation = torch.cat([torch.randn(1, 130), torch.ones(1, 1), torch.tensor([[1.0, 0.0]])], dim=1)
    boosted, moved = observation.clone(), observation.clone()
    boosted[:, 130], moved[:, 131:] = 3.0, torch.tensor([[0.0, 1.0]])
    ratio = navigator.policy(boosted).stddev / navigator.policy(observation).stddev
    torch.testing.assert_close(ratio, torch.tensor([[1.0, 3.0, 1.0]]))
    assert torch.equal(navigator.policy(moved).mean, navigator.policy(observation).mean)
    assert not torch.equal(navigator.value(moved), navigator.value(observation))


def test_the_boost_is_the_paper_s_at_iteration_80_and_never_less_than_none():
    assert annealed(BOOSTS["annealed"], 80) == pytest.approx(load_claims()["cov.boost_scale"].paper, rel=1e-12)
    assert annealed(BOOSTS["annealed"], 10_000) == 1.0 and annealed(Boost(), 7) == 1.0
    assert {annealed(BOOSTS["held"], i) for i in (1, 80)} == {BOOSTS["held"].first}


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_message_is_late_by_the_latency_and_held_while_its_anchor_moves(encoder, latency):
    n, rng = 6, np.random.default_rng(0)
    arena, scouts = Arena(LAYOUT, n), Scouts(LAYOUT, encoder, "oracle", n, latency)
    scenes = draw_scenes(LAYOUT, n, rng)
    slab, everyone = np.arange(n) % 2, np.ones(n, bool)
    arena.reset(everyone, scenes.spawn, slab, scenes.scout)
    scouts.look(everyone, arena, 1 - slab)  # the truth is not what it is told
    for age in range(latency):
        assert (scouts.wires(arena, np.full(n, age)) == 0).all()
    first = scouts.wires(arena, np.full(n, latency))
    arena.step(np.tile([1.0, 0.0, 0.0], (n, 1)))
    second = scouts.wires(arena, np.full(n, latency + 1))
    assert torch.equal(first[:, ANCHOR], torch.from_numpy(1 - slab).float())
    assert torch.equal(first[:, ANCHOR:], second[:, ANCHOR:]) and not torch.equal(first[:, 0], second[:, 0])


def test_diagnostics_find_a_message_intact_and_commands_obeyed(encoder):
    rng = np.random.default_rng(0)
    assert message_error(LAYOUT, encoder, 16, rng) < 1e-6
    assert command_error(LAYOUT, 16, rng).max() < 0.01


def test_rewards_are_distance_gained_through_the_nearer_corridor_plus_the_goal_less_the_slab(encoder):
    n = 8
    errand = Errand(NavigatorConfig(envs=n, hazard=3.0), encoder, np.random.default_rng(0))
    arena, ahead = errand._arena, np.tile([1.0, 0.0, 0.0], (n, 1))
    slab = np.arange(n) % 2
    y = np.where(slab == 0, 0.4, -0.4)  # of the exits
    pose = np.column_stack([np.full(n, 0.6), y, np.zeros(n)])  # before the slab
    pose[4:, :2] = LAYOUT.goal.x - LAYOUT.goal.radius - 0.12, 0.0  # before the goal
    arena.reset(np.ones(n, bool), pose, slab, arena.scout)
    rewards = np.zeros(n)
    for _ in range(5):
        step = errand.step(ahead, boost=1.0)
        rewards += np.where(rewards < -1, 0.0, step.rewards) * (rewards < 4)
    gained = np.array([0.15] * 4 + [0.12] * 4)  # metres, within a step's travel
    np.testing.assert_allclose(rewards, gained + np.array([-3.0] * 4 + [5.0] * 4), atol=0.06)
    away = np.tile([-1.0, 0.0, 0.0], (n, 1))
    arena.reset(np.ones(n, bool), np.tile([-2.0, 0.0, 0.0], (n, 1)), slab, arena.scout)
    arena.step(away)
    before = np.array([errand._distance(arena.pose[:, :2], np.full(n, side)) for side in (0, 1)]).min(axis=0)
    step = errand.step(away, boost=1.0)
    after = np.array([errand._distance(arena.pose[:, :2], np.full(n, side)) for side in (0, 1)]).min(axis=0)
    np.testing.assert_allclose(step.rewards, before - after, atol=1e-9)
    assert (step.rewards < -0.02).all() and not step.ended.any()


def test_the_curriculum_starts_past_the_mouths_and_the_decision_is_met_from_the_spawn_alone(encoder):
    pose = Errand(NavigatorConfig(envs=400), encoder, np.random.default_rng(0))._arena.pose
    near = pose[:, 0] <= LAYOUT.barrier[0]
    assert (np.abs(pose[near, :2] - LAYOUT.spawn.array[:2]) <= LAYOUT.spawn.jitter[0] + 1e-9).all()
    assert 0.5 < near.mean() < 0.8  # draws of the free arena before the mouths go to the spawn too
    shown = Errand(NavigatorConfig(envs=400, starts="anywhere"), encoder, np.random.default_rng(0))._arena.pose
    assert ((shown[:, 0] <= LAYOUT.barrier[0]) & (np.abs(shown[:, 1]) > 0.5)).sum() > 20


def test_training_repeats_itself_goes_on_from_where_another_stood_and_logs_only_episodes_from_the_spawn(weights):
    config = NavigatorConfig(steps=512, envs=4, rollout=64, blocked="right", content="oracle")
    once, again = (train_navigator(config, 0, report=quiet, encoder=weights) for _ in range(2))
    assert all(np.array_equal(once[name], again[name]) for name in once)
    assert len(once["boost"]) == 2 and (once["episodes"][:, 1] == 1).all()
    still = train_navigator(config.model_copy(update={"lr": 1e-12}), 0, report=quiet, encoder=weights, start=once)
    names = [name for name in once if name.startswith("navigator.")]
    assert all(np.allclose(still[name], once[name], atol=1e-6) for name in names)


# --- episodes
def test_episodes_equal_a_literal_loop_of_one_robot_at_a_time(encoder):
    n, horizon, across = 8, 150, 1.0
    slab = np.arange(n) % 2
    imposed = Imposed(np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.zeros(n))
    played = play(LAYOUT, encoder, driver(0.8, across), "floor", slab, slab, imposed, horizon, np.random.default_rng(5))
    scenes = draw_scenes(LAYOUT, n, np.random.default_rng(5))
    for i in range(n):
        arena, first, entered = Arena(LAYOUT, 1), NO_CORRIDOR, [False, False]
        arena.reset(np.ones(1, bool), scenes.spawn[[i]], slab[[i]], scenes.scout[[i]])
        for t in range(horizon):
            if t % 4 == 0:
                np.testing.assert_allclose(played.path[i, t // 4], arena.pose[0, :2], atol=1e-6)
            arena.step(np.array([[0.8, across, 0.0]]))
            corridor = arena.corridor[0]
            first = corridor if first == NO_CORRIDOR else first
            if corridor != NO_CORRIDOR:
                entered[corridor] = True
        assert first == played.first[i] and entered == played.entered[i].tolist()
    assert {0, NO_CORRIDOR} & set(played.first) and not played.success.any() and (played.length == horizon).all()


def test_an_episode_ends_at_the_goal_and_the_others_go_on(encoder):
    near = LAYOUT.model_copy(update={"goal": LAYOUT.goal.model_copy(update={"x": -1.9, "y": 0.0, "radius": 0.4})})
    n = 12
    imposed = Imposed(np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.zeros(n))
    slab = np.zeros(n, np.int64)
    played = play(near, encoder, driver(1.0, 0.0), "floor", slab, slab, imposed, 40, np.random.default_rng(0))
    assert 0 < played.success.sum() and (played.length[played.success] < 40).all()
    ended = played.length[played.success][0]
    path = played.path[played.success][0]
    assert np.isfinite(path[: -(-ended // 4)]).all() and np.isnan(path[-(-ended // 4) :]).all()


def test_a_navigator_s_bit_shift_is_that_of_its_mean_in_its_own_standard_deviations(encoder):
    navigator = driver(0.0, 0.0)
    navigator.message.weight[:, ANCHOR] = 1.0  # reads the bit
    n = 3
    imposed = Imposed(np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.zeros(n))
    slab = np.zeros(n, np.int64)
    deaf = play(LAYOUT, encoder, navigator, "oracle", slab, slab, imposed, 8, np.random.default_rng(0))
    assert (deaf.shift == 0).all()  # its output layer ignores what the receiver makes of it
    navigator.velocity = torch.nn.Linear(96, 3)
    torch.nn.init.zeros_(navigator.velocity.weight)
    navigator.velocity.weight.requires_grad_(False)[LATERAL, 64] = 0.5
    hears = play(LAYOUT, encoder, navigator, "oracle", slab, slab, imposed, 8, np.random.default_rng(0))
    expected = 0.5 / np.exp(-0.5) * 7 / 8  # nothing has arrived at the first of the eight steps
    np.testing.assert_allclose(hears.shift, expected, rtol=1e-5)


def test_episodes_can_start_in_front_of_either_mouth_and_share_all_else():
    for start, side in (("left", 1), ("right", -1)):
        moved = started(LAYOUT, start)
        spawn = moved.spawn.sample(50, np.random.default_rng(0))
        assert (spawn[:, 1] * side > 1).all() and (np.abs(spawn[:, 0] + 1.8) <= LAYOUT.spawn.jitter[0]).all()
        assert moved.walls == LAYOUT.walls
    assert started(LAYOUT, "spawn") is LAYOUT


# --- judgements
def test_the_window_ratio_is_the_paper_s_and_grows_linearly_with_the_boost():
    ratio = judgements.window_ratio(RolloutConfig(), BOOSTS["annealed"])
    assert ratio == load_claims()["cov.window_ratio"].paper
    assert judgements.window_ratio(RolloutConfig(), BOOSTS["annealed"], 3.6) == pytest.approx(ratio * 3.6)
    for window, factor in ((0, 1.0), (40, 0.0)):
        with pytest.raises(ValueError, match="window_ratio"):
            judgements.window_ratio(RolloutConfig(), Boost(window=window), factor)


@pytest.mark.parametrize(("horizon", "window", "ratio"), [(300, 40, 6.5), (600, 60, 9.0), (40, 40, 0.0), (12, 40, 0.0)])
def test_the_window_ratio_follows_the_settings_in_use(horizon, window, ratio):
    assert judgements.window_ratio(RolloutConfig(horizon=horizon), Boost(window=window)) == ratio


def test_the_windowed_row_and_the_boosts_share_one_window():
    assert {WINDOWED["cov.window_ar"].window} == {boost.window for boost in BOOSTS.values()}


def test_opposition_enumerates_every_order_ties_included():
    x, y = np.array([(0, 90), (0, 80), (3, 80), (9, 20), (8, 30), (20, 10)]).T / 128
    rho, p = judgements.opposition(x, y)
    assert rho == pytest.approx(spearmanr(x, y).statistic)
    rng = np.random.default_rng(0)
    shuffled = np.mean([spearmanr(x, rng.permutation(y)).statistic <= rho + 1e-9 for _ in range(400)])
    assert abs(p - shuffled) < 0.03
    straight = np.arange(7) / 128
    assert judgements.opposition(straight, 1 - straight) == (pytest.approx(-1), pytest.approx(1 / 5040))
    assert judgements.opposition(np.zeros(7), straight) == (0.0, 1.0)


def test_success_off_the_alternative_leaves_out_whoever_entered_it():
    covered = np.array([[True, True, False, False]])
    assert judgements.off_alternative(covered, np.array([[True, False, True, False]])) == 0.5
    assert judgements.off_alternative(covered, ~covered) == 1.0
    assert np.isnan(judgements.off_alternative(np.ones((1, 4), bool), covered))


def test_a_curriculum_is_chosen_by_the_worse_mouth_and_by_commitment_and_not_by_coverage():
    slab = np.array([[0, 0, 1, 1]])
    mouths = [{"success": np.array([[1, 1, 1, 1]])}, {"success": np.array([[1, 1, 0, 0]])}]
    committed, torn = ({"first": np.array([first]), "slab": slab} for first in ([1, 1, 1, 1], [1, 1, 1, 0]))
    assert judgements.drives_and_commits(committed, mouths) == 0.5
    assert judgements.drives_and_commits(torn, mouths) == 0.25


def test_alternative_success_counts_blocked_incumbents_between_the_edges():
    rng = np.random.default_rng(0)
    episodes = np.column_stack([rng.integers(0, 20, 300), *rng.integers(0, 2, (3, 300))])
    result, edges = {"episodes": episodes, "boost": np.ones(20)}, (0, 7, 14)
    counts = judgements.alternative_success(result, 1, edges)
    for low, high, (succeeded, n) in zip(edges[:-1], edges[1:], counts, strict=True):
        kept = [e for e in episodes if low <= e[0] < high and e[1] == 1]
        assert (succeeded, n) == (sum(e[3] for e in kept), len(kept))


def test_alternative_outcomes_are_those_episodes_and_leave_empty_intervals_out():
    episodes = np.array([(0, 1, 0, 1), (3, 1, 0, 0), (3, 0, 0, 1), (12, 1, 0, 1)])
    parts = judgements.alternative_outcomes([{"episodes": episodes}], [1], (0, 7, 10, 14))
    assert [part.tolist() for part in parts] == [[[True, False]], [[True]]]
    other = np.array([(0, 0, 0, 1), (12, 0, 1, 0), (13, 0, 1, 1)])  # another incumbent, and fewer early episodes
    both = judgements.alternative_outcomes([{"episodes": episodes}, {"episodes": other}], [1, 0], (0, 7, 14))
    assert [part.tolist() for part in both] == [[[True], [True]], [[True], [False]]]


def test_the_held_command_is_sideways_travel_over_full_command():
    t = np.arange(0, 40, 4)
    path = np.stack([0 * t, -0.02 * t], axis=1)[None]  # 0.02 m a step to the right, whatever happens forward
    result = {"path": np.stack([path, path])}
    assert judgements.held_command(result, step=0.05, window=30) == pytest.approx(0.4)
    assert judgements.held_command(result, step=0.05, window=600) == pytest.approx(0.4)  # the path's end at the latest


def test_entering_no_corridor_is_neither_optimal_nor_commitment():
    result = {"first": np.array([[0, 0, -1, 0]]), "slab": np.array([[0, 1, 1, 0]])}
    assert judgements.optimal(result).tolist() == [False, True, False, False]
    assert judgements.commitment(result) == (0, 0.5)
    assert not judgements.has_committed(result)
    assert judgements.has_committed({"first": np.zeros((1, 4)), "slab": result["slab"]})


def test_settings_are_the_paper_s():
    claims = load_claims()
    assert RolloutConfig().episodes == claims["cov.episodes"].paper
    assert tuple(DIRECT) == Configuration.__args__ and len(DIRECT) == claims["port.null"].n
    assert {*TABLE_2, *WINDOWED} <= set(claims)


# --- looks
@pytest.mark.parametrize("content", ["floor", "oracle"])
def test_a_training_kept_at_a_look_equals_one_that_ends_there(weights, content):
    shared = {"content": content, "starts": "anywhere", "envs": 8, "rollout": 16, "minibatch": 64}
    longer = train_navigator(NavigatorConfig(**shared, steps=384, looks=(128, 256)), 0, report=quiet, encoder=weights)
    for look in (128, 256):
        ended = train_navigator(NavigatorConfig(**shared, steps=look), 0, report=quiet, encoder=weights)
        kept = stopped(longer, look, look // 128)
        assert kept.keys() == ended.keys()
        for name, value in ended.items():
            np.testing.assert_array_equal(kept[name], value, err_msg=name)


def test_a_look_between_updates_is_refused():
    with pytest.raises(ValidationError, match="multiples of 128 up to 384 control steps, got 200"):
        NavigatorConfig(envs=8, rollout=16, steps=384, looks=(200,))
    with pytest.raises(UserError, match=r"navigator.steps: must be one of pretraining.looks \(128, 256\), got 384"):
        require_looks(NavigatorConfig(envs=8, rollout=16, steps=384), PretrainingConfig(looks=(128, 256)))
    with pytest.raises(UserError, match=r"pretraining.bit_looks: expected multiples of 128 control steps, got 100"):
        require_looks(NavigatorConfig(envs=8, rollout=16, steps=128), PretrainingConfig(looks=(128,), bit_looks=(100,)))


def test_some_rows_are_observed_as_all_are(encoder):
    errand = Errand(NavigatorConfig(envs=6, content="oracle"), encoder, np.random.default_rng(0))
    errand.step(np.tile([1.0, 0.3, 0.0], (6, 1)), 2.0)
    rows = np.array([4, 1])
    torch.testing.assert_close(errand.observe(2.0, rows), errand.observe(2.0)[rows], atol=1e-5, rtol=0)


def test_contact_and_time_cost_what_the_settings_say_and_contact_ends_an_episode_only_if_it_should(encoder):
    for ends in (True, False):
        config = NavigatorConfig(envs=2, hazard=3.0, slab_ends=ends, step_cost=0.25)
        errand = Errand(config, encoder, np.random.default_rng(0))
        arena = errand._arena
        pose = np.array([[0.7, 0.4, 0.0], [-3.0, 0.0, 0.0]])  # just before the left slab, and at the spawn
        arena.reset(np.ones(2, bool), pose, np.zeros(2, np.int64), np.tile([2.3, 0.0, np.pi], (2, 1)))
        for _ in range(5):  # pressed against the slab, no distance is gained
            step = errand.step(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), 1.0)
            if step.terminated[0]:
                break
        assert step.terminated.tolist() == [ends, False]
        assert step.rewards[1] == pytest.approx(-0.25, abs=1e-4)
        if not ends:
            assert step.rewards[0] == pytest.approx(-3.25, abs=0.01)
