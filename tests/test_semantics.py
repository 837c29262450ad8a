"""What is configured by name and could silently be something else: each test fails if the thing is the identity,
sees the wrong data, or is judged on what it was trained on.
"""

import numpy as np
import pytest
import torch
from torch import nn

from lt_lib import ppo
from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.envs import measured
from lt_lib.envs.camera import FastCamera, network_input
from lt_lib.envs.layout import NO_CORRIDOR, load_layout
from lt_lib.gridworld.episodes import greedy, play
from lt_lib.gridworld.map import Grid
from lt_lib.gridworld.mappo import Actor, Inputs
from lt_lib.gridworld.walks import first_states
from lt_lib.hardware.probe import CameraTransfer, Probe, fit_probe, transfer
from lt_lib.hardware.sessions import Session
from lt_lib.perception import gates, jepa, objective
from lt_lib.perception.encoder import Encoder, FrozenEncoder, Predictor
from lt_lib.perception.frames import Rollouts, random_rollouts
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels import redraw
from lt_lib.pixels.episodes import Outcomes, draw_scenes
from lt_lib.pixels.executor import Driving
from lt_lib.pixels.route import evaluate_head, train_head
from lt_lib.report.shares import LAST, final_episodes, final_shares
from lt_lib.settings.perception import EncoderConfig, GateConfig
from lt_lib.settings.pixels import EvaluationConfig, HeadConfig, RedrawConfig
from lt_lib.settings.streams import Stream
from lt_lib.settings.velocity import Boost, NavigatorConfig
from lt_lib.speed.step import encoder_passes
from lt_lib.velocity import navigator as velocity

LAYOUT = load_layout("default")


def quiet(_: float) -> None:
    """A run's progress, unheard."""


@pytest.fixture(scope="module")
def weights() -> dict[str, np.ndarray]:
    """An untrained encoder and predictor."""
    torch.manual_seed(0)
    parts = {"E": Encoder(), "P": Predictor()}
    state = {f"{p}.{k}": v.numpy() for p, module in parts.items() for k, v in module.state_dict().items()}
    return state | {"mean": np.zeros(64, np.float32), "std": np.ones(64, np.float32)}


# --- the objective


def small_jepa() -> objective.Jepa:
    torch.manual_seed(0)
    return objective.Jepa(nn.Linear(3, 64), torch.ones(4), 1)


def test_each_term_of_the_objective_is_the_one_it_is_named_after():
    model, rng = small_jepa(), torch.Generator().manual_seed(0)
    latent, goal = torch.randn(32, 64, generator=rng) / 4, torch.randn(32, 64, generator=rng)
    actions, classes = torch.randn(32, 3, generator=rng), torch.randint(0, 4, (32, 1, 1), generator=rng)
    losses = model.losses(latent, actions, goal, classes)
    spread = (latent.var(dim=0) + 1e-4).sqrt()
    torch.testing.assert_close(losses.variance, (1 - spread).clamp(min=0).mean())
    assert 0.5 < losses.variance < 1
    torch.testing.assert_close(losses.covariance, objective.covariance_loss(latent))
    assert losses.covariance > 0
    torch.testing.assert_close(losses.prediction, (model.predictor(latent, actions) - goal).square().mean())


@pytest.mark.parametrize("ema", [0.0, 0.5])
def test_the_target_follows_the_encoder_at_its_rate_after_every_update(ema, monkeypatch):
    model, rates = small_jepa(), []
    follow = objective.Jepa.follow
    monkeypatch.setattr(objective.Jepa, "follow", lambda self, decay: (rates.append(decay), follow(self, decay)))
    before = model.target.weight.clone()
    config = EncoderConfig(epochs=1.0, batch=8, ema=ema)
    frames = torch.randn(4, 5, 3)

    def losses(r, t):
        classes = torch.zeros(len(r), 1, 1, dtype=torch.long)
        return model.losses(model.encoder(frames[r, t]), torch.zeros(len(r), 3), model.goal(frames[r, t + 1]), classes)

    objective.fit(model, losses, (4, 5), config, np.random.default_rng(0), quiet)
    assert rates == [ema] * 2  # 16 steps in batches of 8
    assert not torch.equal(model.target.weight, before)
    assert torch.equal(model.target.weight, model.encoder.weight) == (ema == 0)


def test_the_encoder_predicts_the_next_frame_of_the_same_rollout(monkeypatch):
    number, length = 3, 4
    frames = np.arange(number * length, dtype=np.uint8).reshape(number, length, 1, 1) % 11
    frames = np.broadcast_to(frames, (number, length, 64, 64)).copy()  # each frame shows its own number
    poses, actions = np.zeros((2, number, length, 3), np.float32)
    slab = np.zeros(number, np.int64)
    monkeypatch.setattr(jepa, "random_rollouts", lambda *_: Rollouts(frames, poses, actions, slab))
    seen, wanted = [], []
    monkeypatch.setattr(jepa.Encoder, "forward", lambda self, x: (seen.append(x), torch.zeros(len(x), 64))[1])
    monkeypatch.setattr(jepa.Jepa, "goal", lambda self, x: (wanted.append(x), torch.zeros(len(x), 64))[1])
    monkeypatch.setattr(jepa, "fit", lambda model, losses, *_: losses(np.array([0, 2]), np.array([1, 2])) and {})
    jepa.train_encoder(EncoderConfig(frames=12, rollout=4), 0, report=quiet)
    np.testing.assert_array_equal(seen[0], network_input(frames[[0, 2], [1, 2]]))
    np.testing.assert_array_equal(wanted[0], network_input(frames[[0, 2], [2, 3]]))


# --- the freeze gates


def test_the_gates_are_measured_on_frames_that_nothing_was_trained_on(weights, monkeypatch):
    drawn = {}
    for module in (jepa, gates):

        def recorded(layout, n, length, rng, name=module.__name__):
            drawn[name] = random_rollouts(layout, n, length, rng)
            return drawn[name]

        monkeypatch.setattr(module, "random_rollouts", recorded)
    monkeypatch.setattr(jepa, "fit", lambda *_: {})
    jepa.train_encoder(EncoderConfig(frames=160, rollout=8), 0, report=quiet)
    seen = np.arange(160).reshape(20, 8) % 2 == 0
    monkeypatch.setattr(gates, "hazard_visible", lambda _: seen)
    monkeypatch.setattr(gates, "_picture", lambda *_: {})
    gates.measure_gates(GateConfig(rollouts=20, length=8), 0, report=quiet, encoder=weights)
    training, held_out = (drawn[module.__name__].poses for module in (jepa, gates))
    assert training.shape == held_out.shape  # of one generator they would be the same
    assert not np.isclose(training, held_out).all(axis=-1).any()


def test_the_gates_probes_are_scored_on_rollouts_that_they_were_not_fitted_on(weights, monkeypatch):
    fitted, scored = [], []

    class Probe:
        def __init__(self, **_): ...

        def fit(self, x, y):
            fitted.append(x)
            return self

        def predict(self, x):
            scored.append(x)
            return np.zeros(len(x))

        def score(self, x, y):
            scored.append(x)
            return 0.0

    for name in ("LogisticRegression", "LinearRegression"):
        monkeypatch.setattr(gates, name, Probe)
    monkeypatch.setattr(gates, "_picture", lambda *_: {})
    gates.measure_gates(GateConfig(rollouts=10, length=4), 0, report=quiet, encoder=weights)
    assert len(fitted) == len(scored) == 2
    for train, test in zip(fitted, scored, strict=True):
        assert len(train) + len(test) == 40
        assert not (train[:, None] == test).all(axis=-1).any()


# --- messages and what happens to them


def test_the_predicted_latent_is_the_predictor_s_and_not_the_latent(weights):
    encoder, draws, slab = FrozenEncoder(weights), draw_scenes(LAYOUT, 4, np.random.default_rng(0)), np.zeros(4, int)
    frames = FastCamera(LAYOUT).frames(draws.scout, slab, draws.spawn[:, :2])
    sender = Sender(LAYOUT, encoder, frames, draws.scout, np.zeros((4, 2)), slab)
    latent, predicted = CONTENTS["latent"](sender), CONTENTS["predicted"](sender)
    assert (latent - predicted).abs().max() > 0.01
    torch.testing.assert_close(predicted, encoder.predicted(frames, torch.zeros(4, 3)))


def ideal_bank(n: int) -> dict:
    """A bank in which the commanded corridor is always driven, and succeeds when it is free."""
    free = np.broadcast_to(~np.eye(2, dtype=bool), (n, 2, 2))
    route = np.broadcast_to(np.arange(2), (n, 2, 2))
    outcomes = {"success": free, "length": 0 * route, "contacts": 0 * route, "entered": route}
    draws = draw_scenes(LAYOUT, n, np.random.default_rng(0))._asdict()
    return draws | outcomes | {"commit_step": 2, "held_out": 0.5}


def test_a_head_is_evaluated_under_the_corruption_that_is_named(weights):
    inputs = {"bank": ideal_bank(64), "encoder": weights}
    head = train_head(HeadConfig(content="oracle", episodes=2500), 0, report=quiet, **inputs)
    optimal = {}
    for wire in CORRUPTIONS:
        config = EvaluationConfig(content="oracle", wire=wire, episodes=64)
        optimal[wire] = evaluate_head(config, 0, report=quiet, head=head, **inputs)["optimal"].mean()
    assert optimal.pop("intact") == 1
    assert max(optimal.values()) < 0.8, optimal


class Ears(Actor):
    """In place of the gridworld's actor: remembers the wires that reach it, and stays."""

    def __init__(self):
        nn.Module.__init__(self)
        self.wires, self.present = [], []

    def forward(self, own, wires, present):
        self.wires.append(wires[:, 0])
        self.present.append(present[:, 0])
        return torch.zeros(len(own), 5)


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_gridworld_policy_hears_nothing_before_the_latency_and_then_what_the_corruption_leaves(latency):
    grid, n = Grid(load_layout("grid")), 8
    own = torch.zeros(len(grid.cells), 2, 64)
    where = torch.ones(1 + len(grid.posts), len(grid.cells), 2) / 4
    inputs = Inputs(own, where, torch.ones(1 + len(grid.posts), 2, 3), torch.ones(where.shape[:2], dtype=torch.bool))
    for wire in ("intact", "content_zeroed", "wire_zeroed"):
        ears, rng = Ears(), np.random.default_rng(0)
        play(grid, inputs, ears, first_states(grid, n, rng), wire, greedy, rng, latency)
        heard = torch.stack(ears.wires)  # (t, n, w)
        assert not heard[:latency].any() and not torch.stack(ears.present)[:latency].any()
        assert torch.stack(ears.present)[latency:].all()
        assert heard[latency:, :, 2:].any() == (wire == "intact")
        assert heard[latency:, :, :2].any() == (wire != "wire_zeroed")


# --- what trainings see


def test_both_corridors_are_blocked_in_the_navigator_s_training_unless_one_is_named(weights):
    encoder = FrozenEncoder(weights)
    for blocked, low, high in (("random", 0.35, 0.65), ("left", 0, 0), ("right", 1, 1)):
        errand = velocity.Errand(NavigatorConfig(envs=128, blocked=blocked), encoder, np.random.default_rng(0))
        assert low <= errand._arena.slab.mean() <= high


@pytest.fixture
def driving(weights) -> Driving:
    return Driving(LAYOUT, FrozenEncoder(weights), 128, np.random.default_rng(0))


def test_both_corridors_are_blocked_and_commanded_in_the_executor_s_training(driving):
    assert 0.35 < driving._arena.slab.mean() < 0.65
    assert 0.35 < driving.route.mean() < 0.65


def test_the_executor_is_paid_for_coming_nearer_and_obeys_only_in_the_corridor_it_was_told(driving):
    n, arena = driving._arena.n, driving._arena
    everyone, slab = np.ones(n, bool), np.arange(n) // 2 % 2
    driving.route = np.arange(n) % 2
    arena.reset(everyone, np.tile(LAYOUT.spawn.array, (n, 1)), slab, arena.scout)
    rewards, *_ = driving.step(np.tile([1.0, 0.0, 0.0], (n, 1)))
    back, *_ = driving.step(np.tile([-1.0, 0.0, 0.0], (n, 1)))
    assert (rewards > 0).all() and (back < 0).all()
    told_right = driving.route == 1
    in_the_left_corridor = np.array([-1.2, 1.25, 0.0])
    arena.reset(everyone, np.tile(in_the_left_corridor, (n, 1)), slab, arena.scout)
    _, obedient, terminated, *_ = driving.step(np.zeros((n, 3)))
    assert not obedient.any()  # nobody has arrived or met a slab
    np.testing.assert_array_equal(terminated, told_right)


def test_the_boost_is_annealed_as_the_updates_go_by(weights, monkeypatch):
    asked = []

    def collect(errand, navigator, chains, config, boost, rng):
        asked.append(boost)
        errand.finished.append(np.zeros((1, 3)))

    monkeypatch.setattr(velocity, "_collect", collect)
    monkeypatch.setattr(ppo, "update", lambda *_: None)
    boost = Boost(first=5.0, last=2.0, at=3)
    config = NavigatorConfig(envs=2, rollout=1, steps=8, boost=boost)
    result = velocity.train_navigator(config, 0, report=quiet, encoder=weights)
    assert asked == pytest.approx([4.0, 3.0, 2.0, 1.0])
    assert result["boost"].tolist() == asked


def test_a_redrawn_episode_is_optimal_where_the_free_corridor_is_entered_first(weights, monkeypatch):
    entered = np.array([0, 1, NO_CORRIDOR])

    class Played:
        def __init__(self, *_): ...

        def play(self, head, draws, slab, chance):
            self.slab = slab
            Played.slab = slab
            outcome = Outcomes(np.ones(3, bool), np.ones(3, int), np.zeros(3, int), entered)
            return outcome, redraw.Decisions(np.arange(3), torch.zeros(3, 66), torch.zeros(3, dtype=torch.long), None)

    monkeypatch.setattr(redraw, "LiveArena", Played)
    monkeypatch.setattr(redraw, "_improve", lambda *_: 0.0)
    scenes = {name: ideal_bank(8)[name] for name in redraw.SCENES}
    config = RedrawConfig(episodes=3, batch=3)
    result = redraw.train_redrawn_head(config, 0, report=quiet, scenes=scenes, encoder=weights, executor={})
    expected = [first == 1 - slab for first, slab in zip(entered, Played.slab, strict=True)]
    assert result["optimal"].tolist() == expected and any(expected)


# --- what results are made of


def test_the_refit_probe_sees_the_refit_session_and_no_other():
    rng, hazard = np.random.default_rng(0), np.arange(40) % 2 == 0
    latents = {name: rng.normal(size=(40, 64)) + hazard[:, None] for name in ("simulated", "refit", "live")}
    sessions = [Session(np.zeros((40, 1, 1, 3), np.uint8), hazard, *[np.zeros(40)] * 2, hazard) for _ in latents]

    class Reading(PictureEncoder):
        def __init__(self):
            self.rows = iter(latents.values())

        def latents(self, _):
            return next(self.rows)

    made = transfer(Reading(), sessions[0], dict(zip(("refit", "live"), sessions[1:], strict=True)))
    for name, probe in (("simulated", made.simulated), ("refit", made.refit)):
        np.testing.assert_array_equal(probe.weights, fit_probe(latents[name], hazard).weights)


def test_the_registered_rule_keeps_the_simulated_probe_unless_it_misses_the_gate():
    one, other = Probe(np.eye(64)[0], 0.0), Probe(np.eye(64)[1], 0.0)
    latents = {"refit": np.random.default_rng(0).normal(size=(50, 64))}
    for made_of, kept in ((0, one), (1, other)):  # the hazard is read off this float
        made = CameraTransfer(one, other, latents, {"refit": latents["refit"][:, made_of] > 0})
        assert made.registered(0.95) is kept


def test_a_seed_ends_with_its_last_episodes_and_not_with_all():
    seeds = [{"optimal": np.arange(1200) >= start} for start in (600, 900)]
    np.testing.assert_allclose(final_shares(seeds, "optimal"), [1.0, 0.6])
    assert final_episodes(seeds, "optimal").shape == (2, LAST)


def test_conditions_and_seeds_have_streams_of_their_own():
    draws = [
        stream.generator(seed, *names).random()
        for stream in (Stream.HEAD, Stream.CORRUPTION)
        for seed in (0, 1)
        for names in ((), ("floor", "intact"), ("position", "intact"), ("floor", "wire_zeroed"))
    ]
    assert len(set(draws)) == len(draws)


def test_rows_without_a_message_meet_scenes_of_their_own(weights):
    bank = ideal_bank(64)
    heads = {
        name: train_head(HeadConfig(content=name, episodes=64, batch=32, minibatch=16), 0, report=quiet, bank=bank,
                         encoder=weights)
        for name in ("floor", "position")
    }  # fmt: skip
    assert (heads["floor"]["optimal"] != heads["position"]["optimal"]).any()
    one = heads["floor"]
    np.testing.assert_array_equal(one["success"], one["optimal"])  # in this bank the free corridor is the way
    assert set(np.unique(one["route"])) == {0, 1}


def test_a_message_takes_no_further_pass_of_the_encoder(weights):
    assert encoder_passes(LAYOUT, weights) == {"floor": 2, "latent": 2}


def test_settings_measured_where_they_act_are_those_that_were_set():
    for name in ("default", "matched"):
        layout = load_layout(name)
        assert measured.field_of_view(layout) == pytest.approx(layout.camera.fov, abs=0.05)
    assert measured.rates(LAYOUT) == pytest.approx((10, 60))
    assert measured.speeds(LAYOUT) == pytest.approx((0.5, 1.5))
    wide = LAYOUT.model_copy(update={"camera": LAYOUT.camera.model_copy(update={"fov": 60.0})})
    assert measured.field_of_view(wide) == pytest.approx(60.0, abs=0.05)
