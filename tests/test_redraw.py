"""The live head: against the bank's drive and train_head at k = 0, against a literal loop at any k."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from lt_lib import ppo
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.perception.encoder import Encoder, FrozenEncoder, Predictor
from lt_lib.pixels import episodes, redraw
from lt_lib.pixels.episodes import Outcomes, draw_scenes, drive, roll_bank
from lt_lib.pixels.executor import Executor, FrozenExecutor
from lt_lib.pixels.redraw import CREDITS, REDRAWS, Decisions, LiveArena, draws_per_episode, train_redrawn_head
from lt_lib.pixels.route import train_head
from lt_lib.report.judges import falls
from lt_lib.settings.base import layout_path
from lt_lib.settings.pixels import BankConfig, HeadConfig, RedrawConfig
from lt_lib.settings.ppo import PpoConfig

ROWS = redraw.FRAMES_AT_ONCE  # the batches of `drive` and the blocks of the live code then have one size
COMMIT_STEP = 2
SHORT = 45  # control steps, in place of 600


def quiet(_: float) -> None:
    """A run's progress, unheard."""


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch):
    for module in (episodes, redraw):
        monkeypatch.setattr(module, "HORIZON", SHORT)


@pytest.fixture(scope="module")
def frozen() -> SimpleNamespace:
    """Random weights; the executor pushes forward and steers by its route, so that routes and arrivals differ."""
    torch.manual_seed(0)
    parts, policy = {"E": Encoder(), "P": Predictor()}, Executor()
    encoder = {f"{p}.{k}": v.numpy() for p, m in parts.items() for k, v in m.state_dict().items()}
    with torch.no_grad():
        policy.mean[0].weight[:, -2:] = torch.randn(128, 1) * torch.tensor([1.0, -1.0])
        policy.mean[-1].weight.copy_(torch.randn(3, 128) * torch.tensor([[0.04], [0.04], [0.02]]))
        policy.mean[-1].bias.copy_(torch.tensor([0.3, 0.0, 0.0]))
    executor = {k: v.detach().numpy() for k, v in policy.state_dict().items()}
    return SimpleNamespace(
        encoder=encoder | {"mean": np.zeros(64, np.float32), "std": np.full(64, 0.03, np.float32)}, executor=executor
    )


def layout_file(tmp_path, **changes) -> str:
    path = tmp_path / "near.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(layout_path("default").read_text()) | changes))
    return str(path)


@pytest.fixture
def near(tmp_path) -> str:
    """A goal that some episodes reach soon."""
    return layout_file(tmp_path, goal={"x": -2.2, "y": 0.6, "radius": 0.4})


@pytest.fixture
def seen(tmp_path) -> str:
    """A spawn between slab and scout, who sees every step; beside it a slab that some touch, and a goal."""
    spawn = {"x": 1.75, "y": 0.3, "heading": 150.0, "jitter": [0.05, 0.05, 90.0]}
    return layout_file(tmp_path, spawn=spawn, goal={"x": 1.9, "y": -0.9, "radius": 0.8})


def some_head(seed: int = 0) -> RouteHead:
    torch.manual_seed(seed)
    head = RouteHead(66)
    torch.nn.init.normal_(head.logits.weight, 0, 0.1)
    return head


def some_episodes(path: str, n: int, config: RedrawConfig, seed: int = 0):
    rng = np.random.default_rng(seed)
    draws, slab = draw_scenes(load_layout(path), n, rng), rng.integers(0, 2, n)
    return draws, slab, rng.random((n, draws_per_episode(config.every, COMMIT_STEP)))


def test_one_draw_an_episode_is_the_bank_s_episode_exactly(frozen, near):
    config = RedrawConfig(layout=near, envs=ROWS)
    draws, slab, chance = some_episodes(near, 30, config)
    outcome, decisions = LiveArena(config, COMMIT_STEP, frozen.encoder, frozen.executor).play(
        some_head(), draws, slab, chance
    )
    np.testing.assert_array_equal(decisions.episode, np.arange(30))
    route = decisions.routes.numpy()
    assert 5 < route.sum() < 25
    encoder, executor, scene = FrozenEncoder(frozen.encoder), FrozenExecutor(frozen.executor), load_layout(near)
    expected = drive(Arena(scene, ROWS), FastCamera(scene), encoder, executor, draws, slab, route, COMMIT_STEP, SHORT)
    for name, values in expected._asdict().items():
        np.testing.assert_array_equal(getattr(outcome, name), values, err_msg=name)
    assert outcome.success.any() and not outcome.success.all()


def test_training_with_one_draw_an_episode_is_training_on_the_bank(frozen, near):
    bank = roll_bank(
        BankConfig(layout=near, entries=4, envs=ROWS, held_out=0.25),
        0,
        report=quiet,
        encoder=frozen.encoder,
        executor=frozen.executor,
    )
    sizes = {"layout": near, "episodes": 40, "batch": 16, "minibatch": 8}
    on_bank = train_head(HeadConfig(**sizes), 3, report=quiet, bank=bank, encoder=frozen.encoder)
    live = train_redrawn_head(
        RedrawConfig(**sizes, envs=ROWS), 3, report=quiet, scenes=bank, encoder=frozen.encoder, executor=frozen.executor
    )
    for name in ("success", "length", "contacts"):
        np.testing.assert_array_equal(live[name], on_bank[name])
    for name in (*(n for n in live if n.startswith("head.")), "entropy"):
        np.testing.assert_allclose(live[name], on_bank[name], rtol=0, atol=1e-4, err_msg=name)
    assert live["entropy"][-1] < live["entropy"][0] - 1e-3  # it did learn something


def literal_episode(path, frozen, head, spawn, scout, slab, chance, every, latency):
    """One episode, one row, nothing remembered: every frame rendered and encoded, every message sent."""
    layout = load_layout(path)
    arena, camera = Arena(layout, 1), FastCamera(layout)
    encoder, executor = FrozenEncoder(frozen.encoder), FrozenExecutor(frozen.executor)
    arena.reset(np.ones(1, bool), spawn[None], np.array([slab]), scout[None])
    route, entered, contacts, log, rewards, sent = 0, -1, 0, [], [], {}
    for step in range(SHORT):
        sent[step] = encoder.latent(camera.frames(scout[None], arena.slab, arena.pose[:, :2]))
        if step >= 2 and (step - 2) % every == 0:
            offset = torch.from_numpy((scout[None, :2] - arena.pose[:, :2]) / layout.communication_radius).float()
            late = sent.get(step - latency)
            wire = torch.zeros(1, 66) if late is None else torch.cat([offset, late], dim=1)
            route = int(chance[(step - 2) // every] < head.policy(wire).probs[0, 1].item())
            log.append((wire[0], route))
            rewards.append(0.0)
        own = encoder.latent(camera.frames(arena.pose, arena.slab, scout[None, :2]))
        arena.step(executor.mean_action(own, np.array([route])) if step >= 2 else np.zeros((1, 3)))
        contacts += int(arena.contact[0])
        if rewards:
            rewards[-1] += float(arena.reached[0]) - 0.01 * arena.contact[0]
        if entered == -1:
            entered = arena.corridor[0]
        if arena.reached[0]:
            break
    return (arena.reached[0], step + 1, contacts, entered), log, rewards


@pytest.mark.parametrize(("every", "latency"), [(7, 1), (1, 1), (7, 0), (7, 3), (1, 3)])
def test_live_episodes_are_those_of_a_literal_loop_whatever_runs_beside_them(every, latency, frozen, seen):
    config, head = RedrawConfig(layout=seen, every=every, envs=ROWS, latency=latency), some_head(1)
    draws, slab, chance = some_episodes(seen, ROWS + 9, config)  # more than rows: some are seated later
    outcome, decisions = LiveArena(config, COMMIT_STEP, frozen.encoder, frozen.executor).play(head, draws, slab, chance)
    moved = 0.0
    for e in (0, 5, ROWS + 8):
        ended, log, rewards = literal_episode(
            seen, frozen, head, draws.spawn[e], draws.scout[e], slab[e], chance[e], every, latency
        )
        assert tuple(values[e] for values in outcome) == ended
        mine = decisions.episode == e
        wires, routes = zip(*log, strict=True)
        assert decisions.routes[mine].tolist() == list(routes)
        torch.testing.assert_close(decisions.wires[mine], torch.stack(wires), rtol=0, atol=2e-3)
        np.testing.assert_allclose(decisions.rewards[mine], rewards, rtol=0, atol=1e-9)
        moved = max(moved, (wires[0] - wires[-1])[2:].abs().max().item())
    assert moved > 0.1  # the scout's view, and with it the message, changed on the way
    assert outcome.success.any() and outcome.contacts.any() and len(np.unique(outcome.length)) > 2


def test_how_many_rows_play_makes_no_difference(frozen, seen):
    config = RedrawConfig(layout=seen, every=5, envs=ROWS)
    draws, slab, chance = some_episodes(seen, 24, config)
    few, many = (
        LiveArena(config.model_copy(update={"envs": envs}), COMMIT_STEP, frozen.encoder, frozen.executor).play(
            some_head(), draws, slab, chance
        )
        for envs in (ROWS, 2 * ROWS)
    )
    for name, values in few[0]._asdict().items():
        np.testing.assert_array_equal(values, getattr(many[0], name), err_msg=name)
    np.testing.assert_array_equal(few[1].episode, many[1].episode)
    assert torch.equal(few[1].routes, many[1].routes)


def ragged() -> tuple[Decisions, Outcomes]:
    """Three episodes of 3, 1 and 2 draws; the second touches the slab, the third times out."""
    episode = np.array([0, 0, 0, 1, 2, 2])
    rewards = np.array([0.0, 0.0, 1.0, 0.98, -0.05, -0.02])
    outcome = Outcomes(np.array([True, True, False]), np.array([9, 9, 9]), np.array([0, 2, 7]), np.array([0, 1, 1]))
    return Decisions(episode, torch.zeros(6, 66), torch.zeros(6, dtype=torch.long), rewards), outcome


def test_every_draw_is_credited_with_its_episode_s_whole_return():
    values = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    gain, returns = CREDITS["episode"](*ragged(), values, PpoConfig())
    torch.testing.assert_close(returns, torch.tensor([1.0, 1.0, 1.0, 0.98, -0.07, -0.07]))
    torch.testing.assert_close(gain, returns - values)


def test_generalised_credit_is_the_literal_sum_within_an_episode():
    (decisions, outcome), config = ragged(), PpoConfig(gamma=0.9, lam=0.8)
    values = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    expected = []
    for i, e in enumerate(decisions.episode):
        total = 0.0
        for j in range(i, 6):
            if decisions.episode[j] != e:
                break
            last = j == 5 or decisions.episode[j + 1] != e
            delta = decisions.rewards[j] + (0.0 if last else 0.9 * values[j + 1].item()) - values[j].item()
            total += (0.9 * 0.8) ** (j - i) * delta
        expected.append(total)
    gain, returns = CREDITS["gae"](decisions, outcome, values, config)
    torch.testing.assert_close(gain, torch.tensor(expected).float())
    torch.testing.assert_close(returns, gain + values)


def test_an_update_takes_as_many_gradient_steps_however_often_the_route_is_drawn(monkeypatch):
    sizes = []
    monkeypatch.setattr(ppo, "update", lambda head, optimiser, batch, config, minibatch, rng: sizes.append(minibatch))
    for draws in (1, 20):
        episode = np.repeat(np.arange(256), draws)
        decisions = Decisions(episode, torch.zeros(len(episode), 66), torch.zeros(len(episode), dtype=torch.long), None)
        outcome = Outcomes(*np.zeros((4, 256), int))
        redraw._improve(some_head(), None, outcome, decisions, RedrawConfig(), None)
    assert sizes == [64, 64 * 20]


def test_nothing_but_the_redraw_differs_from_the_heads_on_the_bank():
    mine, head, bank = RedrawConfig(), HeadConfig(), BankConfig()
    for name in ("latency", "episodes", "batch", "minibatch", "lr", "ppo"):
        assert getattr(mine, name) == getattr(head, name)
    assert mine.envs == bank.envs
    assert {"held_out", "commit_step"} <= set(redraw.SCENES)  # the bank's own
    rows = {(row.content, row.every, row.credit) for name, row in REDRAWS.items() if not name.endswith("gae")}
    assert rows == {
        (content, k, mine.credit) for content, k in (("latent", 0), ("latent", 30), ("latent", 1), ("oracle", 1))
    }


def test_the_order_holds_only_if_every_step_of_it_does():
    def seeds(*shares: float) -> np.ndarray:
        return np.stack([np.arange(100) < round(100 * share) for share in shares])

    high, middle, low = (seeds(*np.array([5, 4, 3, 2, 1]) / 100 + least) for least in (0.95, 0.89, 0.7))
    clear = falls(high, middle, low)
    assert (clear["value"], clear["holds"], clear["p"]) == ("monotone", True, pytest.approx(1 / 252))
    tied = falls(high, middle, seeds(0.94, 0.93, 0.92, 0.91, 0.89))
    assert (tied["value"], tied["holds"], tied["p"] > 0.3) == ("monotone", False, True)
    turned = falls(middle, high, low)
    assert (turned["value"], turned["holds"]) == ("not monotone", False)
