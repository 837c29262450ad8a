"""The controls: senders, ladder, readers, layouts, the split of the variance, the gridworld's twin, predictions."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from sklearn.metrics import log_loss

from lt_lib.beyond import grid as twin, readers, senders
from lt_lib.beyond.ladder import draw_ladder_scenes, label, photographed
from lt_lib.beyond.layouts import SAMPLED, sampled_layouts, written
from lt_lib.beyond.protocol import frozen, read_rungs
from lt_lib.beyond.variance import perfect_bank, split_variance
from lt_lib.comm.channel import ANCHOR
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import HAZARD, INDEX, PALETTE
from lt_lib.envs.occlusion import require_occlusion
from lt_lib.gridworld.map import Grid
from lt_lib.gridworld.mappo import Inputs, TableTeam, Team
from lt_lib.gridworld.views import cells
from lt_lib.perception.encoder import Encoder, FrozenEncoder
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.report.predictions import HELD, NO_VERDICT, NOT_HELD, PREDICTIONS, Predictions
from lt_lib.settings.base import LAYOUTS, ROOT, UserError
from lt_lib.settings.beyond import (
    EndToEndConfig,
    GridReaderConfig,
    PatchSenderConfig,
    ReaderConfig,
    Rung,
    SenderConfig,
    SenderGateConfig,
)

SMALL = SenderConfig(frames=512, rollout=32, epochs=1.0, every=4)
DRAWS = 64


def quiet(_: float) -> None:
    pass


def trained(name: str, **changes) -> dict:
    sender = senders.SENDERS[name]
    return sender.train(SMALL.model_copy(update={"kind": name, **sender.changes, **changes}), 0, report=quiet)


@pytest.fixture(scope="module")
def layout():
    return load_layout("default")


@pytest.fixture(scope="module")
def bank():
    return perfect_bank("default", DRAWS)


@pytest.fixture(scope="module")
def spawn(layout):
    return layout.spawn.sample(40, np.random.default_rng(0))


# --- senders
def test_every_sender_freezes_to_the_same_form():
    pictures = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    for name in senders.SENDERS:
        weights = frozen(trained(name))
        assert PictureEncoder(weights).latent(pictures).shape == (3, 64), name
        assert all(name.startswith("E.") or name in ("mean", "std") for name in weights)


def test_senders_see_the_frames_of_the_paper_s_encoder():
    from lt_lib.perception.frames import random_rollouts
    from lt_lib.settings.streams import Stream

    theirs = random_rollouts(load_layout("default"), 512 // 32, 32, Stream.ENCODER.generator(0))
    np.testing.assert_array_equal(senders.frames_of(SMALL, 0).rollouts.frames, theirs.frames)


def test_principal_components_are_those_of_a_full_decomposition():
    pictures = senders.frames_of(SMALL, 0)
    r, t = (axis.ravel() for axis in np.meshgrid(np.arange(16), np.arange(0, 32, 4)))  # one batch: nothing is forgotten
    pixels = pictures.colours(r, t).reshape(len(r), -1).astype(np.float64)
    exact = np.linalg.svd(pixels - pixels.mean(0), full_matrices=False)[2][:64]
    ours = trained("pca")["E.linear.weight"]
    overlap = np.abs((ours * exact).sum(axis=1))
    np.testing.assert_allclose(overlap[:16], 1, atol=1e-3)  # the leading ones, which nothing equals in size
    assert np.linalg.svd(ours @ exact.T, compute_uv=False).min() > 0.99  # and all the subspace
    latents = (pixels - pixels.mean(0)) @ ours.T
    network = PictureEncoder({"E.linear.weight": ours, "E.linear.bias": trained("pca")["E.linear.bias"],
                              "mean": np.zeros(64, np.float32), "std": np.ones(64, np.float32)})  # fmt: skip
    np.testing.assert_allclose(network.latents((pixels * 255).round().astype(np.uint8).reshape(-1, 64, 64, 3)),
                               latents, atol=0.05)  # fmt: skip


def test_a_random_projection_keeps_distances():
    matrix = trained("random")["E.linear.weight"]
    pairs = np.random.default_rng(1).normal(size=(200, 12_288))
    ratio = np.linalg.norm(pairs @ matrix.T, axis=1) / np.linalg.norm(pairs, axis=1)
    assert abs(ratio.mean() - 1) < 0.05


def test_the_contrastive_loss_is_that_of_a_literal_loop():
    rng, n, temperature = np.random.default_rng(0), 5, 0.3
    one, other = rng.normal(size=(2, n, 7))
    codes = [each / np.linalg.norm(each) for each in (*one, *other)]
    losses = []
    for i in range(2 * n):
        similar = {j: np.exp(codes[i] @ codes[j] / temperature) for j in range(2 * n) if j != i}
        losses.append(-np.log(similar[(i + n) % (2 * n)] / sum(similar.values())))
    loss = senders.cross_entropy_of_pairs(torch.from_numpy(one), torch.from_numpy(other), temperature)
    assert loss.item() == pytest.approx(np.mean(losses))


def test_contrastive_pairs_are_frames_of_one_rollout_a_few_steps_apart(monkeypatch):
    seen = []

    def black(_, r, t):
        seen.append((r, t))
        return np.zeros((len(r), 64, 64, 3), np.float32)

    monkeypatch.setattr(senders.Pictures, "colours", black)
    trained("contrastive")
    for (r, t), (r_later, later) in zip(seen[::2], seen[1::2], strict=False):
        if len(r) == SMALL.batch:  # the last look is the normalisation's sample
            np.testing.assert_array_equal(r, r_later)
            assert ((later > t) & (later <= np.minimum(t + SMALL.apart, 31))).all()


def test_the_supervised_sender_learns_the_blocked_corridor(monkeypatch):
    given = {}

    def recorded(network, terms, config, seed, report):
        pictures = senders.frames_of(config, seed)
        model = network()
        r, t = np.arange(16), np.full(16, 5)
        logits = model.logit(model.encoder(torch.from_numpy(pictures.colours(r, t)))).detach().numpy().ravel()
        given["loss"] = terms(model, pictures)(r, t).item()
        given["expected"] = log_loss(pictures.rollouts.slab[r], 1 / (1 + np.exp(-logits)), labels=[0, 1])
        return {}

    monkeypatch.setattr(senders, "trained", recorded)
    senders.supervised(SMALL, 0, report=quiet)
    assert given["loss"] == pytest.approx(given["expected"], rel=1e-4)


def test_a_sender_that_is_taught_where_the_slab_shows_sees_no_other_frame(monkeypatch):
    seen = []
    monkeypatch.setattr(senders.Judging, "loss", lambda self, pictures, r, t: (
        seen.append(pictures.rollouts.frames[r, t]), self.logit.bias.square())[1])  # fmt: skip
    trained("supervised_showing")
    assert seen and all(HAZARD[frames].any((1, 2)).all() for frames in seen)


def test_the_autoencoder_learns_to_rebuild_what_it_sees():
    result = trained("autoencoder", epochs=10.0, lr=3e-3, batch=32)
    assert result["loss"][-1] < result["loss"][0] / 4
    model, pictures = senders.Autoencoder(), torch.rand(2, 64, 64, 3)
    rebuilt = model.decoder(model.encoder(pictures)).detach().numpy()
    errors = [
        (rebuilt[n, c, i, j] - pictures[n, 4 * i : 4 * i + 4, 4 * j : 4 * j + 4, c].mean().item()) ** 2
        for n, c, i, j in np.ndindex(rebuilt.shape)
    ]
    assert rebuilt.shape == (2, 3, 16, 16) and model.loss(pictures).item() == pytest.approx(np.mean(errors), rel=1e-4)


def test_silence_says_the_same_of_every_picture():
    pictures = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8)
    assert not PictureEncoder(frozen(trained("silence"))).latent(pictures).any()


def test_a_sender_s_gates_are_measured_on_frames_of_its_own_kind():
    config = SenderGateConfig(rollouts=20, length=8, colour=1.0)
    weights = frozen(trained("pca"))
    plain = senders.measure_sender(config.model_copy(update={"colour": 0.0}), 0, report=quiet, sender=weights)
    coloured = senders.measure_sender(config, 0, report=quiet, sender=weights)
    assert plain["walls"] > coloured["walls"]  # it knew the simulator's colours alone


# --- the ladder
def test_the_first_rung_is_the_paper_s_scene(layout, spawn):
    scenes = draw_ladder_scenes(layout, Rung(), spawn, np.random.default_rng(3))
    frames = [FastCamera(layout).frames(scenes.scout, np.full(40, slab), spawn[:, :2]) for slab in (0, 1)]
    np.testing.assert_array_equal(scenes.pictures, np.stack([colours(each) for each in frames], axis=1))
    low, high = layout.scout.array - 0.06, layout.scout.array + 0.06
    assert ((scenes.scout >= low) & (scenes.scout <= high)).all()
    np.testing.assert_array_equal(scenes.slab_pixels, np.stack([HAZARD[each].sum((1, 2)) for each in frames], axis=1))


def test_pixel_noise_replaces_its_share_of_pixels():
    frames = np.full((50, 64, 64), INDEX["floor"], np.uint8)
    pictures = photographed(frames, Rung(noise=0.3), np.random.default_rng(0))
    other = (pictures != PALETTE[INDEX["floor"]]).any(-1).mean()
    expected = 0.3 * (1 - 1 / len(PALETTE))  # a random material may be the floor's own
    assert abs(other - expected) < 4 * np.sqrt(expected / frames.size)


def test_random_appearance_recolours_floor_and_walls_and_nothing_else():
    frames = np.tile(np.arange(len(PALETTE), dtype=np.uint8), (30, 64, 1))[:, :, :11]
    frames = np.pad(frames, ((0, 0), (0, 0), (0, 53)), constant_values=INDEX["sky"])
    shown = photographed(frames, Rung(appearance=1.0), np.random.default_rng(0))[:, 0, :11].astype(int)
    same = (np.abs(shown - PALETTE) <= 1).all(-1)  # (frames, materials)
    surfaces = [INDEX[name] for name in ("floor", "wall_x", "wall_y", "barrier_x", "barrier_y")]
    kept = np.delete(np.arange(11), surfaces)
    assert same[:, kept].all() and same[:, surfaces].mean() < 0.1
    half = photographed(frames, Rung(appearance=0.5), np.random.default_rng(0))[:, 0, :11].astype(int)
    np.testing.assert_allclose(half, (shown + PALETTE) / 2, atol=1)


def test_exposure_scales_a_frame_by_stops():
    frames = np.full((2_000, 64, 64), INDEX["barrier_y"], np.uint8)[:, :8, :8]
    shown = (
        photographed(frames, Rung(exposure=0.5), np.random.default_rng(0))[:, 0, 0, 2] / PALETTE[INDEX["barrier_y"], 2]
    )
    assert np.log2(shown).std() == pytest.approx(0.5, abs=0.05) and np.log2(shown).mean() == pytest.approx(0, abs=0.05)


def test_an_object_stands_in_every_view_and_is_no_slab(layout, spawn):
    yellow, red = (
        draw_ladder_scenes(layout, Rung(redness=each), spawn, np.random.default_rng(1)) for each in (0.0, 1.0)
    )
    there = (yellow.pictures == PALETTE[INDEX["robot"]]).all(-1)
    assert (there.sum((2, 3)) > 0).mean() > 0.9  # a slab may hide one
    assert (red.pictures[there] == PALETTE[INDEX["slab_x"]]).all()
    np.testing.assert_array_equal(red.slab_pixels, yellow.slab_pixels)
    plain = draw_ladder_scenes(layout, Rung(), spawn, np.random.default_rng(1))
    assert not (plain.pictures == PALETTE[INDEX["robot"]]).all(-1).any()  # the barrier hides the navigator


def test_a_scout_anywhere_stands_beyond_the_barrier_and_sees_the_slab(layout, spawn):
    scenes = draw_ladder_scenes(layout, Rung(anywhere=True, least=60), spawn, np.random.default_rng(2))
    assert (scenes.scout[:, 0] > layout.barrier[1]).all()
    assert layout.free(*scenes.scout[:, :2].T, layout.robot.radius).all()
    assert (scenes.slab_pixels.max(axis=1) >= 60).all() and (scenes.slab_pixels.min(axis=1) < 60).any()
    assert np.ptp(scenes.scout[:, 2]) > 3  # any heading


def test_back_and_jitter_move_the_post(layout, spawn):
    scenes = draw_ladder_scenes(layout, Rung(back=1.5, jitter=10.0), spawn, np.random.default_rng(0))
    x, y, heading = (scenes.scout - layout.scout.array).T
    assert x.mean() == pytest.approx(1.5, abs=0.2) and 0.4 < np.abs(y).max() <= 0.5
    assert np.deg2rad(25) < np.abs(heading).max() <= np.deg2rad(30)


@pytest.mark.parametrize(
    ("rungs", "words"),
    [
        ([{"noise": 1.5}], "rungs.0.noise"),
        ([{"glare": 1}], "unknown parameter"),
        ([{"anywhere": True, "back": 1.0}], "no post"),
        ([{}], "unknown rung 'noise 0.6'"),
    ],
)
def test_an_unusable_ladder_is_refused_in_one_line(rungs, words):
    with pytest.raises(UserError, match=words) as error:
        read_rungs(rungs)
    assert "\n" not in str(error.value)


def test_a_rung_is_named_by_what_it_changes():
    assert label(Rung()) == "the paper's scene"
    assert label({"anywhere": True, "noise": 0.1}) == "noise 0.1 + anywhere"


# --- readers
def test_heads_never_train_on_the_scenes_that_they_are_tested_on(bank):
    config = ReaderConfig(sender="any", repeats=2)
    scenes = readers.scenes_of(config, bank)
    number = torch.arange(len(scenes.spawn), dtype=torch.float32)[:, None, None].expand(-1, 2, 64).clone()
    training, held_out = readers.split(config, bank, scenes, number)
    apart = (
        {int(each) % DRAWS for each in training.contents[:, 0, 0]},
        {int(e) % DRAWS for e in held_out.contents[:, 0, 0]},
    )
    assert not apart[0] & apart[1] and len(apart[1]) == DRAWS // 8
    assert len(training.contents) + len(held_out.contents) == 2 * DRAWS


def test_scenes_are_the_same_for_every_sender(bank):
    one, other = (readers.scenes_of(ReaderConfig(sender=name, rung=Rung(noise=0.1)), bank) for name in ("a", "b"))
    np.testing.assert_array_equal(one.pictures, other.pictures)


def test_a_head_without_a_message_is_right_in_exactly_one_half_and_one_with_the_bit_always(bank, monkeypatch):
    config = ReaderConfig(sender="any", episodes=1_500, heads=1, rung=Rung(anywhere=True))
    silent = readers.train_readers(config, 0, report=quiet, bank=bank, sender=frozen(trained("silence")))
    assert silent["greedy"].mean() == silent["few"].mean() == silent["probe"] == 0.5
    bit = torch.tensor([0.0, 1.0])[None, :, None]
    monkeypatch.setattr(readers, "sent", lambda _, pictures: bit.expand(len(pictures), 2, 64))
    told = readers.train_readers(config, 0, report=quiet, bank=bank, sender=frozen(trained("silence")))
    assert told["greedy"].mean() == told["probe"] == 1.0


def test_an_untrained_encoder_is_read_in_the_paper_s_scene(bank):
    config = ReaderConfig(sender="any", episodes=1_500, heads=2, repeats=4)
    result = readers.train_readers(config, 0, report=quiet, bank=bank, sender=frozen(trained("untrained")))
    assert result["greedy"].shape == (2, 4 * DRAWS // 8 * 2)
    assert result["greedy"].mean() > 0.95 and result["few"].shape == result["greedy"].shape
    assert result["optimal"].shape == (2, 1_500)


def test_the_policy_s_gradient_reaches_the_sender_that_learns_and_no_frozen_one(layout):
    wires = torch.rand(4, ANCHOR + 64 * 64 * 3)
    policy = readers.EndToEnd()
    torch.nn.init.normal_(policy.head.logits.weight)  # at zero the logits pass nothing back yet
    policy.evaluate(wires, torch.tensor([0, 1, 0, 1]))[0].sum().backward()
    assert policy.encoder.layers[0].weight.grad.abs().sum() > 0
    sender, head = PictureEncoder(frozen(trained("untrained"))), RouteHead(ANCHOR + 64)
    said = sender.latent((wires[:, ANCHOR:].unflatten(1, (64, 64, 3)) * 255).numpy().astype(np.uint8))
    head.evaluate(torch.cat([wires[:, :ANCHOR], said], dim=1), torch.tensor([0, 1, 0, 1]))[0].sum().backward()
    assert not any(parameter.requires_grad for parameter in sender._encoder.parameters())
    assert head.hidden[0].weight.grad is not None


def test_a_message_is_learned_end_to_end_and_then_frozen_like_any_other(bank):
    config = EndToEndConfig(sender="end to end", episodes=2_000, repeats=2)
    result = readers.train_end_to_end(config, 0, report=quiet, bank=bank)
    assert result["optimal"][-256:].mean() > 0.9 > result["optimal"][:256].mean()
    initial = trained("untrained")["E.layers.0.weight"]
    assert not np.allclose(result["E.layers.0.weight"], initial, atol=1e-4)
    read = readers.train_readers(
        ReaderConfig(sender="frozen", episodes=1_000, heads=1), 0, report=quiet, bank=bank, sender=frozen(result)
    )
    assert read["greedy"].mean() > 0.9


def test_the_paper_s_encoder_says_the_same_as_pictures_and_as_indices(layout, spawn):
    weights = trained("jepa")
    scout = layout.scout.sample(40, np.random.default_rng(0))
    frames = FastCamera(layout).frames(scout, np.zeros(40, int), spawn[:, :2])
    ours = PictureEncoder(frozen(weights)).latent(colours(frames))
    torch.testing.assert_close(ours, FrozenEncoder(weights).latent(frames), rtol=1e-3, atol=1e-3)


# --- layouts and variance
def test_the_sampled_layouts_are_the_committed_ones_and_pass_the_occlusion_check():
    for name, layout in sampled_layouts().items():
        assert (LAYOUTS / f"{name}.yaml").read_text() == written(layout)
        require_occlusion(load_layout(name))
    assert len({load_layout(name).barrier for name in SAMPLED}) == len(SAMPLED)


def test_the_variance_split_is_that_of_a_balanced_analysis_of_variance():
    rng, (a, b, n) = np.random.default_rng(5), (4, 6, 5)
    values = 0.7 + rng.normal(0, 0.2, (a, 1, 1)) + rng.normal(0, 0.1, (a, b, 1)) + rng.normal(0, 0.05, (a, b, n))
    head = values.var(axis=2, ddof=1).mean()
    encoder = values.mean(axis=2).var(axis=1, ddof=1).mean() - head / n
    layout = values.mean(axis=(1, 2)).var(ddof=1) - values.mean(axis=2).var(axis=1, ddof=1).mean() / b
    np.testing.assert_allclose(split_variance(values), (layout, encoder, head), rtol=0.02)
    assert sum(split_variance(values).shares) == pytest.approx(1)


def test_equal_values_have_no_variance_to_split():
    assert split_variance(np.full((2, 3, 2), 0.5)).shares == (0, 0, 0)


# --- the gridworld's twin
WALKS = PatchSenderConfig(frames=5_120, epochs=1.0)


@pytest.fixture(scope="module")
def eyes():
    return twin.GRID_SENDERS["untrained"].train(WALKS.model_copy(update={"epochs": 0.0}), 0, report=quiet)


def test_every_sender_of_the_gridworld_is_read(eyes):
    config = GridReaderConfig(sender="any", steps=256, envs=4, rollout=64)
    for name, sender in twin.GRID_SENDERS.items():
        weights = sender.train(WALKS.model_copy(update=dict(sender.changes)), 0, report=quiet)
        result = twin.train_grid_reader(config, 0, report=quiet, encoder=eyes, sender=frozen(weights))
        assert np.isfinite(result["entropy"]).all(), name


@pytest.mark.parametrize("name", twin.GRID_SENDERS)
def test_a_sender_of_the_gridworld_depends_on_its_seed_alone(name):
    sender = twin.GRID_SENDERS[name]
    one, other = (sender.train(WALKS.model_copy(update=dict(sender.changes)), 0, report=quiet) for _ in range(2))
    for key in frozen(one):
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def test_a_talking_team_computes_what_a_team_with_its_contents_does_and_teaches_its_sender(eyes):
    grid = Grid(load_layout("grid"))
    views = cells(grid, eyes)
    inputs = Inputs.of(grid, views, "latent")
    team = twin.TalkingTeam(inputs, views)
    torch.nn.init.normal_(team.actor.logits.weight)
    torch.nn.init.normal_(team.actor.receiver.value.weight)
    table = team.log_probs()
    places = torch.tensor([[0, 3, 1], [1, 5, 0], [1, 5, 1], [1, 9, 1]])
    picked = table[places[:, 0], places[:, 1], places[:, 2]]
    torch.testing.assert_close(picked, Team.logits(team, places).log_softmax(-1), rtol=1e-4, atol=1e-5)
    table[:, :, :, 0].sum().backward()
    assert team.sender.layers[0].weight.grad.abs().sum() > 0
    said = team.sender(torch.from_numpy(views.posts[0]))
    torch.testing.assert_close(team.inputs.contents[1], said)
    assert "sender" not in dict(TableTeam(inputs).named_children())


# --- predictions
def test_predictions_are_judged_once_each_and_only_at_full_size(tmp_path):
    for profile, verdicts in (("full", {HELD, NOT_HELD}), ("smoke", {NO_VERDICT})):
        found = Predictions("11_controls", tmp_path, profile)
        with pytest.raises(UserError, match="nothing found for ctl.silence"):
            found.write()
        for i, name in enumerate(found.predicted):
            found.add(name, 0.1, holds=bool(i % 2), p=0.01)
        with pytest.raises(UserError, match="already added"):
            found.add("ctl.silence", 0.1, holds=True)
        with pytest.raises(UserError, match="is not one of its predictions"):
            found.add("ctl.none", 0.1, holds=True)
        with pytest.raises(UserError, match="finite"):
            Predictions("11_controls", tmp_path, profile).add("ctl.silence", float("nan"), holds=True)
        assert set(found.table()["verdict"]) == verdicts
        assert found.write().exists()


def test_every_prediction_is_judged_by_its_notebook():
    for entry in yaml.safe_load(PREDICTIONS.read_text()):
        notebook = (ROOT / "notebooks" / f"{entry['nb']}.ipynb").read_text()
        assert f'\\"{entry["id"]}\\"' in notebook, entry["id"]


def test_an_encoder_has_the_paper_s_architecture_whoever_trains_it():
    shapes = {name: value.shape for name, value in Encoder().state_dict().items()}
    for name in ("contrastive", "autoencoder", "supervised", "untrained"):
        weights = trained(name)
        assert {key.removeprefix("E."): value.shape for key, value in weights.items() if key.startswith("E.")} == shapes
    assert Path(PREDICTIONS).name == "predictions.yaml"
