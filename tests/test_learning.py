"""Objectives and learners against closed forms and literal loops; the bank against live episodes."""

import numpy as np
import pytest
import torch
import yaml

from lt_lib import ppo
from lt_lib.comm.channel import CORRUPTIONS, Channel, measured_latency
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.arena import HORIZON, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import PALETTE
from lt_lib.perception.encoder import Encoder, FrozenEncoder, Predictor
from lt_lib.perception.jepa import GRID, colour_classes
from lt_lib.perception.objective import Jepa, class_weights, covariance_loss, variance_loss
from lt_lib.pixels.episodes import Draws, draw_scenes, drive, roll_bank
from lt_lib.pixels.executor import Executor, FrozenExecutor
from lt_lib.pixels.route import train_head
from lt_lib.settings.base import layout_path
from lt_lib.settings.pixels import BankConfig, HeadConfig
from lt_lib.settings.ppo import PpoConfig

LAYOUT = load_layout("default")
EXACT = {"rtol": 1e-5, "atol": 1e-6}


def quiet(_: float) -> None:
    """A run's progress, unheard."""


@pytest.fixture(scope="module")
def encoder() -> dict[str, np.ndarray]:
    """Random weights, normalised to nothing: enough where no perception is asked for."""
    torch.manual_seed(0)
    parts = {"E": Encoder(), "P": Predictor()}
    weights = {f"{p}.{k}": v.numpy() for p, m in parts.items() for k, v in m.state_dict().items()}
    return weights | {"mean": np.zeros(64, np.float32), "std": np.ones(64, np.float32)}


@pytest.fixture(scope="module")
def executor() -> dict[str, np.ndarray]:
    """Random weights with a push forward, so that the robot gets around and bumps into things."""
    torch.manual_seed(1)
    policy = Executor()
    policy.mean[-1].bias.data = torch.tensor([0.6, 0.0, 0.0])
    return {k: v.detach().numpy() for k, v in policy.state_dict().items()}


def test_advantages_equal_the_literal_sum_and_bootstrap_through_a_time_out():
    rng = np.random.default_rng(0)
    rewards, values, following = (torch.from_numpy(rng.normal(size=(6, 2))) for _ in range(3))
    terminated = torch.zeros(6, 2, dtype=torch.bool)
    ended = terminated.clone()
    terminated[2, 0] = ended[2, 0] = True
    ended[3, 1] = True  # a time-out: no credit across it, but its value counts
    gamma, lam = 0.9, 0.8
    expected = torch.zeros_like(rewards)
    for n in range(2):
        for t in range(6):
            for k in range(t, 6):
                delta = rewards[k, n] + gamma * following[k, n] * float(not terminated[k, n]) - values[k, n]
                expected[t, n] += (gamma * lam) ** (k - t) * delta
                if ended[k, n]:
                    break
    torch.testing.assert_close(ppo.advantages(rewards, values, following, terminated, ended, gamma, lam), expected)


def test_clipped_surrogate_has_no_gradient_once_the_ratio_left_the_clip_in_the_advantage_s_direction():
    ratio = torch.tensor([0.5, 1.0, 1.5, 0.5, 1.5], requires_grad=True)
    advantage = torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0])
    surrogate = ppo.clipped_surrogate(ratio, advantage, 0.2)
    torch.testing.assert_close(surrogate.detach(), torch.tensor([0.5, 1.0, 1.2, -0.8, -1.5]))
    assert torch.autograd.grad(surrogate.sum(), ratio)[0].tolist() == [1.0, 1.0, 0.0, 0.0, -1.0]


def test_update_survives_a_leftover_minibatch_of_one_and_a_constant_advantage():
    head = RouteHead(66)
    optimiser = torch.optim.Adam(head.parameters(), lr=1e-3)
    n = 65
    batch = ppo.Batch(
        torch.randn(n, 66),
        torch.zeros(n, dtype=torch.long),
        torch.full((n,), -0.69),
        torch.ones(n),
        torch.ones(n),
    )
    statistics = ppo.update(head, optimiser, batch, PpoConfig(), minibatch=64, rng=np.random.default_rng(0))
    assert all(np.isfinite(statistics)) and all(p.isfinite().all() for p in head.parameters())


def test_route_head_has_the_paper_s_parameters_and_starts_uniform():
    head = RouteHead(66)
    assert sum(p.numel() for p in head.parameters()) == 4483
    assert torch.equal(head.policy(torch.randn(5, 66)).probs, torch.full((5, 2), 0.5))


def test_variance_and_covariance_losses_equal_their_closed_forms():
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]).double()
    scale = np.sqrt(3 / 4)  # unit sample variance
    torch.testing.assert_close(covariance_loss(signs * scale), torch.tensor(0.0).double())
    twice = torch.stack([signs[:, 0], signs[:, 0]], 1) * scale  # covariance 1 twice off the diagonal, over d = 2
    torch.testing.assert_close(covariance_loss(twice), torch.tensor(1.0).double())
    half = variance_loss(signs * scale * 0.5)
    torch.testing.assert_close(half, torch.tensor(1 - np.sqrt(0.25 + 1e-4)).double())
    assert variance_loss(signs * 3) == 0


def test_reconstruction_classes_come_from_colours_alone_and_weights_average_to_one():
    classes = colour_classes()
    assert len(classes) == len(PALETTE) and set(classes) == set(range(classes.max() + 1))
    pixels = np.array([0, 0, 0, 1])
    weights = class_weights(pixels, 3)
    torch.testing.assert_close(weights[torch.from_numpy(pixels)].mean(), torch.tensor(1.0))
    torch.testing.assert_close(weights[1] / weights[0], torch.tensor(np.sqrt(3.0)).float())
    assert weights[2] == 0


def test_target_follows_by_moving_average_and_gets_no_gradient():
    torch.manual_seed(0)
    model = Jepa(Encoder(), torch.ones(3), GRID)
    before = model.target.layers[0].weight.clone()
    with torch.no_grad():
        model.encoder.layers[0].weight.add_(1.0)
    model.follow(0.9)
    torch.testing.assert_close(model.target.layers[0].weight, before + 0.1, **EXACT)
    frames, classes = torch.rand(4, 64, 64, 3), torch.zeros(4, GRID, GRID, dtype=torch.long)
    sum(model.losses(model.encoder(frames), torch.zeros(4, 3), model.goal(frames), classes)).backward()
    assert all(p.grad is None for p in model.target.parameters())
    assert all(p.grad is not None for p in model.encoder.parameters())


def scout_message(name: str, encoder, slab: int, n: int = 3) -> torch.Tensor:
    pose = LAYOUT.scout.sample(n, np.random.default_rng(3))
    slabs = np.full(n, slab)
    frames = FastCamera(LAYOUT).frames(pose, slabs, np.tile([-3.0, 0.0], (n, 1)))
    return CONTENTS[name](Sender(LAYOUT, FrozenEncoder(encoder), frames, pose, np.zeros((n, 2)), slabs))


@pytest.mark.parametrize("name", CONTENTS)
def test_only_perceptual_and_oracle_messages_depend_on_the_slab(name, encoder):
    left, right = (scout_message(name, encoder, slab) for slab in (0, 1))
    assert left.shape == (3, 64 * 64 * 3 if name == "raw" else 64)
    assert torch.equal(left, right) == (name in ("floor", "position", "trajectory"))


def test_trajectory_is_the_straight_line_that_position_starts():
    pose, velocity = np.array([[1.0, 2.0, 0.3]]), np.array([[0.5, -0.2]])
    sent = CONTENTS["trajectory"](Sender(LAYOUT, None, None, pose, velocity, None))[0].view(32, 2)
    path = np.array([[1.0 + 0.5 * t / 10, 2.0 - 0.2 * t / 10] for t in range(32)]) / LAYOUT.communication_radius
    np.testing.assert_allclose(sent, path, **EXACT)


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_an_impulse_arrives_after_the_latency_and_at_no_other_step(latency):
    assert measured_latency(latency) == latency
    channel, shown = Channel((2,), 3, 10.0, latency), []
    for step in range(12):  # the second team's clock runs five steps behind
        steps = np.array([step, step - 5])
        channel.send(steps, torch.from_numpy(steps == 4).float()[:, None].expand(2, 3), np.ones((2, 2)))
        shown.append(channel.receive(steps, np.zeros((2, 2)))[:, 2:].any(dim=1))
    first, second = torch.stack(shown).T
    assert first.nonzero().flatten().tolist() == [4 + latency]
    assert second.nonzero().flatten().tolist() == [step for step in [9 + latency] if step < 12]


def test_a_channel_adds_the_anchor_on_arrival_and_is_silent_out_of_range_or_before():
    channel, sender = Channel((2,), 64, 10.0), np.array([[3.0, 4.0], [30.0, 0.0]])
    assert (channel.receive(0, np.zeros((2, 2))) == 0).all()
    channel.send(0, torch.ones(2, 64), sender)
    wire = channel.receive(1, np.array([[0.0, 0.0], [1.0, 0.0]]))
    torch.testing.assert_close(wire[0, :2], torch.tensor([0.3, 0.4]))
    assert (wire[0, 2:] == 1).all() and (wire[1] == 0).all()
    near = channel.receive(1, np.array([[0.0, 0.0], [25.0, 0.0]]))
    torch.testing.assert_close(near[1, :2], torch.tensor([0.5, 0.0]))
    assert (channel.receive(2, np.zeros((2, 2))) == 0).all()  # nothing was sent at step 1


def test_each_of_many_senders_has_an_anchor_and_a_range_of_its_own():
    channel = Channel((1, 3), 2, 10.0, corrupt=lambda wires: 2 * wires)
    channel.send(4, torch.arange(6.0).view(1, 3, 2), np.array([[[1.0, 0.0], [0.0, 20.0], [-2.0, 0.0]]]))
    wires = channel.receive(5, np.array([[1.0, 0.0]]))
    expected = torch.tensor([[[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0], [-0.3, 0.0, 4.0, 5.0]]])
    torch.testing.assert_close(wires, 2 * expected)


def test_a_row_that_sends_alone_leaves_the_others_in_flight():
    channel = Channel((2,), 1, 10.0)
    channel.send(0, torch.ones(2, 1), np.zeros((2, 2)))
    channel.send(0, torch.full((1, 1), 7.0), np.zeros((1, 2)), rows=np.array([1]))
    assert channel.receive(1, np.zeros((2, 2)))[:, 2].tolist() == [1.0, 7.0]
    assert channel.receive(np.array([1]), np.zeros((1, 2)), rows=np.array([1]))[:, 2].tolist() == [7.0]


def test_corruptions_do_what_their_names_say():
    rng = np.random.default_rng(0)
    wire = torch.from_numpy(rng.normal(2.0, 3.0, (4000, 5))).float()
    out = {name: corrupt(wire, rng) for name, corrupt in CORRUPTIONS.items()}
    assert torch.equal(out["intact"], wire) and (out["wire_zeroed"] == 0).all()
    for name in ("content_zeroed", "sender_shuffled", "matched_noise"):
        assert torch.equal(out[name][:, :2], wire[:, :2])
    assert (out["content_zeroed"][:, 2:] == 0).all()
    shuffled = out["sender_shuffled"][:, 2:]
    assert not (shuffled == wire[:, 2:]).all(1).any()  # nobody hears its own scout
    assert torch.equal(shuffled.sort(0).values, wire[:, 2:].sort(0).values)
    noise = out["matched_noise"][:, 2:]
    torch.testing.assert_close(noise.mean(0), wire[:, 2:].mean(0), rtol=0, atol=0.25)
    torch.testing.assert_close(noise.std(0), wire[:, 2:].std(0), rtol=0.06, atol=0)


def test_bank_equals_live_episodes_whatever_runs_beside_them(encoder, executor, tmp_path):
    near = yaml.safe_load(layout_path("default").read_text()) | {"goal": {"x": -1.9, "y": 0.2, "radius": 0.3}}
    path = tmp_path / "near.yaml"  # a goal that some episodes reach soon
    path.write_text(yaml.safe_dump(near))
    bank = roll_bank(
        BankConfig(layout=str(path), entries=4, envs=6), 0, report=quiet, encoder=encoder, executor=executor
    )
    entry, slab, route = (axis.ravel()[::-1] for axis in np.indices((4, 2, 2)))  # another order, other neighbours
    scene, crew = load_layout(str(path)), (FrozenEncoder(encoder), FrozenExecutor(executor))
    live = drive(
        Arena(scene, 6),
        FastCamera(scene),
        *crew,
        Draws(bank["spawn"], bank["scout"]).of(entry),
        slab,
        route,
        2,
        HORIZON,
    )
    for name, values in live._asdict().items():
        np.testing.assert_array_equal(bank[name][entry, slab, route], values)
    assert live.success.any() and len(np.unique(live.length)) > 2  # slots were filled again at different times


def ideal_bank(n: int) -> dict[str, np.ndarray]:
    """A bank in which the commanded corridor is always driven, and succeeds when it is free."""
    draws = draw_scenes(LAYOUT, n, np.random.default_rng(0))
    free = np.broadcast_to(np.array([[False, True], [True, False]]), (n, 2, 2))
    route = np.broadcast_to(np.arange(2), (n, 2, 2))
    length, contacts = np.where(free, 200, 600), np.where(free, 0, 400)
    outcomes = {"success": free, "length": length, "contacts": contacts, "entered": route}
    return draws._asdict() | outcomes | {"commit_step": 2, "held_out": 0.125}


@pytest.mark.parametrize(
    ("content", "low", "high"), [("oracle", 0.95, 1.0), ("floor", 0.4, 0.6), ("position", 0.4, 0.6)]
)
def test_a_head_learns_from_reward_alone_what_its_message_tells_and_no_more(content, low, high, encoder):
    result = train_head(HeadConfig(content=content), 0, report=quiet, bank=ideal_bank(256), encoder=encoder)
    assert low <= result["optimal"][-1000:].mean() <= high
    assert len(result["optimal"]) == 6000 and len(result["entropy"]) == 24
