"""The channel as radios are: codecs, losses, waiting, noise and reach; many senders and a liar."""

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from lt_lib.beyond.codes import KINDS, View
from lt_lib.beyond.crowd import blind_poses, crowd_messages, draw_crowd, train_crowd
from lt_lib.beyond.moving import EGO
from lt_lib.beyond.radio import after_waiting, draw_radio_scenes, evaluate_radio, heard, noisy, train_radio
from lt_lib.beyond.senders import frozen
from lt_lib.beyond.variance import perfect_bank
from lt_lib.comm.channel import ANCHOR, Channel, anchor
from lt_lib.comm.codec import TAILS, fit_codec, fit_quantiser, jpeg, jpeg_file
from lt_lib.comm.loss import GilbertElliott
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import load_layout
from lt_lib.envs.occlusion import hazard_pixels
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels.episodes import Outcomes, draw_scenes, held_out_draws
from lt_lib.settings.beyond import CodeConfig, CrowdConfig, LinkConfig, RadioConfig
from lt_lib.settings.perception import EncoderConfig

LAYOUT = load_layout("default")
RADIUS = LAYOUT.communication_radius


def quiet(_: float) -> None:
    pass


@pytest.fixture(scope="module")
def sender():
    return frozen(train_encoder(EncoderConfig(frames=640, epochs=0.0), 0, report=quiet))


@pytest.fixture(scope="module")
def bank():
    return perfect_bank("default", 64)


@pytest.fixture(scope="module")
def values():
    mixing = np.random.default_rng(1).normal(size=(64, 64)) * np.linspace(2, 0.1, 64)
    return np.random.default_rng(0).normal(size=(3_000, 64)) @ mixing.T


# --- codecs
@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_a_quantised_float_comes_back_within_half_a_step(bits, values):
    quantiser = fit_quantiser(values, bits)
    inside = np.clip(values, quantiser.low, quantiser.high)
    codes = quantiser.encode(inside)
    assert codes.min() == 0 and codes.max() == 2**bits - 1
    assert (np.abs(quantiser.decode(codes) - inside) <= quantiser.step / 2 + 1e-9).all()
    np.testing.assert_array_equal(quantiser.encode(quantiser.decode(codes)), codes)  # nothing is lost twice
    low, high = np.quantile(values, TAILS, axis=0)
    outside = quantiser.decode(quantiser.encode(np.stack([low - 5, high + 5])))
    np.testing.assert_allclose(outside, [low + quantiser.step / 2, high - quantiser.step / 2])


@pytest.mark.parametrize(("directions", "bits", "size"), [(64, 32, 2048), (64, 1, 64), (3, 32, 96), (3, 4, 12)])
def test_a_codec_sends_so_many_bits_and_projects_onto_the_first_directions(directions, bits, size, values):
    codec = fit_codec(values, directions, bits)
    sent = codec.encode(values)
    assert codec.bits == size and sent.shape == (len(values), directions)
    if bits < 32:
        assert sent.dtype.kind == "i" and sent.min() >= 0 and sent.max() < 2**bits
    else:
        centred = values - values.mean(0)
        _, _, axes = np.linalg.svd(centred, full_matrices=False)
        expected = centred @ axes[:directions].T @ axes[:directions] + values.mean(0)
        np.testing.assert_allclose(codec.decode(sent), values if directions == 64 else expected, atol=1e-6)


def test_more_bits_and_more_directions_bring_the_latent_nearer(values):
    def error(directions, bits):
        codec = fit_codec(values, directions, bits)
        return np.square(codec.decode(codec.encode(values)) - values).mean()

    assert error(64, 1) > error(64, 2) > error(64, 4) > error(64, 8) > error(64, 32) == 0
    assert error(1, 32) > error(8, 32) > error(32, 32) > 0
    assert error(8, 1) > error(8, 4) > error(8, 32)


def test_a_jpeg_shrinks_with_its_quality_and_is_the_picture_nearly():
    draws = draw_scenes(LAYOUT, 4, np.random.default_rng(0))
    frames = FastCamera(LAYOUT).frames(draws.scout, np.arange(4) % 2, draws.spawn[:, :2])
    pictures = colours(frames)
    fine, large = jpeg(pictures, 95)
    coarse, small = jpeg(pictures, 5)
    assert (small < large).all() and small[0] == 8 * len(jpeg_file(pictures[0], 5))
    errors = [np.abs(each.astype(int) - pictures).mean() for each in (fine, coarse)]
    assert errors[0] < 3 < errors[1]
    red = fine[..., 0].astype(int) - fine[..., 2]
    assert (red > 80).any() and (red < -20).any()  # the colours are not in the other order


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_message_says_its_size(kind, sender):
    draws = draw_scenes(LAYOUT, 3, np.random.default_rng(0))
    slab = np.array([0, 1, 1])
    pictures = colours(FastCamera(LAYOUT).frames(draws.scout, slab, draws.spawn[:, :2]))
    view = View(LAYOUT, PictureEncoder(sender), pictures, slab)
    said = KINDS[kind](CodeConfig(kind=kind, quality=50), view)
    sizes = {"latent": 64 * 32, "oracle": 1, "raw": 64 * 64 * 3 * 32}
    assert said.bits.shape == (3,) and (said.bits == sizes.get(kind, said.bits)).all() and (said.bits > 0).all()
    if kind == "latent":
        torch.testing.assert_close(said.contents, torch.from_numpy(view.encoder.latents(pictures)))
    if kind == "oracle":
        assert said.contents[:, 0].tolist() == [0, 1, 1] and not said.contents[:, 1:].any()


# --- losses
@pytest.mark.parametrize("memory", [0.0, 0.8])
@pytest.mark.parametrize("rate", [0.0, 0.2, 0.7])
def test_a_link_loses_its_share_and_in_bursts_of_the_length_that_it_claims(rate, memory):
    links, steps = 400, 200
    loss = GilbertElliott((links,), rate, memory, np.random.default_rng(0))
    lost = np.stack([loss(np.arange(links)) for _ in range(steps)])  # (steps, links)
    spread = np.sqrt(rate * (1 - rate) / lost.size * (1 + memory) / (1 - memory))
    assert abs(lost.mean() - rate) <= 4 * spread
    if rate:
        again = (lost[1:] & lost[:-1]).sum() / lost[:-1].sum()
        assert again == pytest.approx(rate + memory * (1 - rate), abs=0.02)
        starts = (lost[1:] & ~lost[:-1]).sum()
        assert lost[1:].sum() / starts == pytest.approx(1 / ((1 - rate) * (1 - memory)), rel=0.1)


def test_each_row_and_each_sender_has_a_link_of_its_own():
    loss = GilbertElliott((50, 3), 0.5, 0.0, np.random.default_rng(0))
    lost = np.stack([loss(np.arange(50)) for _ in range(40)]).reshape(40, -1)
    assert np.abs(np.corrcoef(lost.T) - np.eye(150)).max() < 0.75 and 0 < lost.mean(0).min() < lost.mean(0).max() < 1
    few = GilbertElliott((4,), 0.5, 0.5, np.random.default_rng(1))
    assert few(np.array([2])).shape == (1,)


@pytest.mark.parametrize(("rate", "memory"), [(1.0, 0.0), (-0.1, 0.0), (0.5, 1.0)])
def test_impossible_losses_are_refused(rate, memory):
    with pytest.raises(ValueError, match=r"rate and memory must lie in \[0, 1\)"):
        GilbertElliott((1,), rate, memory, np.random.default_rng(0))
    with pytest.raises(ValidationError):
        LinkConfig(loss=rate, memory=memory)


def test_a_lost_message_is_a_silent_wire_and_the_next_one_may_arrive():
    fates = iter([np.array([[True, False]]), np.array([[False, False]])])
    channel, here = Channel((1, 2), 1, 10.0, lost=lambda rows: next(fates)), np.zeros((1, 2))
    for step in (0, 1):
        channel.send(step, torch.ones(1, 2, 1), np.ones((1, 2, 2)))
        wires = channel.receive(step + 1, here)[0]
        assert (wires[:, -1] == torch.tensor([float(step), 1.0])).all() and wires[0].any() == bool(step)


# --- waiting, noise, reach
def listened(n=400, seed=0, **link):
    draws = draw_scenes(LAYOUT, n, np.random.default_rng(3))
    contents = torch.rand(n, 5) + 1
    return draws, contents, heard(LinkConfig(**link), RADIUS, 2, contents, draws, np.random.default_rng(seed))


@pytest.mark.parametrize(("latency", "patience"), [(0, 0), (2, 0), (3, 0), (5, 2), (5, 3), (5, 20)])
def test_a_message_is_heard_when_it_can_first_arrive_or_not_at_all(latency, patience):
    draws, contents, got = listened(latency=latency, patience=patience)
    if latency > 2 + patience:
        assert not got.wires.any() and (got.waited == patience).all()
    else:
        torch.testing.assert_close(got.wires[:, ANCHOR:], contents)
        expected = anchor(draws.scout[:, :2], draws.spawn[:, :2], RADIUS)
        torch.testing.assert_close(got.wires[:, :ANCHOR], expected)
        assert (got.waited == max(0, latency - 2)).all()


def test_whoever_waits_hears_nearly_all_and_bursts_make_the_wait_longer():
    decided = listened(loss=0.5)[2]
    assert decided.wires.any(1).float().mean().item() == pytest.approx(0.5, abs=0.1) and not decided.waited.any()
    single = listened(loss=0.5, patience=40)[2]
    bursts = listened(loss=0.5, memory=0.9, patience=40)[2]
    assert single.wires.any(1).all() and single.waited.mean() == pytest.approx(1.0, abs=0.25)  # geometric, from zero
    assert bursts.waited.mean() > 4 * single.waited.mean()


def test_noise_has_the_power_that_it_claims_and_leaves_the_anchor_alone():
    wire = torch.randn(4_000, 66)
    for decibel in (-10.0, 0.0, 20.0):
        out = noisy(wire, decibel, np.random.default_rng(0))
        torch.testing.assert_close(out[:, :ANCHOR], wire[:, :ANCHOR])
        power = (out - wire)[:, ANCHOR:].square().mean() / wire[:, ANCHOR:].square().mean()
        assert 10 * np.log10(power.item()) == pytest.approx(-decibel, abs=0.1)


def test_beyond_the_reach_nothing_is_heard_and_within_it_everything():
    draws, _, got = listened(reach=5.3)
    apart = np.hypot(*(draws.scout[:, :2] - draws.spawn[:, :2]).T)
    np.testing.assert_array_equal(got.wires.any(1).numpy(), apart <= 5.3)
    assert 0.1 < (apart <= 5.3).mean() < 0.9


def test_waiting_delays_the_end_and_may_miss_the_horizon():
    shape = (3, 2)
    before = Outcomes(np.ones(shape, bool), np.full(shape, 590), np.zeros(shape, int), np.zeros(shape, int))
    after = after_waiting(before, np.array([0, 10, 11]))
    assert after.success[:, 0].tolist() == [True, True, False] and after.length[:, 0].tolist() == [590, 600, 600]


def test_scenes_for_the_test_come_from_draws_that_no_head_was_trained_on(bank):
    scenes = draw_radio_scenes(bank, 400, 100, np.random.default_rng(0))
    kept = {tuple(pose) for pose in bank["spawn"][: held_out_draws(bank)]}
    inside = [tuple(pose) in kept for pose in scenes.draws.spawn]
    assert all(inside[:100]) and not any(inside[100:])
    np.testing.assert_array_equal(scenes.outcomes.success, ~LAYOUT.blocks[scenes.slab])


SMALL = {"scenes": 1_024, "episodes": 1_500, "heads": 1, "held_out": 0.25}


def test_a_head_reads_what_arrives_and_nothing_else(bank, sender):
    def share(**case):
        given = {"code": CodeConfig(**case.get("code", {})), "link": LinkConfig(**case.get("link", {}))}
        config = RadioConfig(**given, **SMALL | {"episodes": 5_000})
        return train_radio(config, 0, report=quiet, bank=bank, sender=sender)

    assert share(code={"kind": "oracle"})["greedy"].mean() > 0.97
    lost = share(code={"kind": "oracle"}, link={"loss": 0.6})
    assert lost["greedy"][:, ~lost["silent"]].mean() > 0.97
    assert abs(lost["greedy"][:, lost["silent"]].mean() - 0.5) < 0.15 and abs(lost["silent"].mean() - 0.6) < 0.1
    assert abs(share(link={"latency": 9})["greedy"].mean() - 0.5) < 0.12


def test_frozen_heads_are_tested_on_the_same_scenes_that_they_were_trained_for(bank, sender):
    config = RadioConfig(**SMALL)
    trained = train_radio(config, 0, report=quiet, bank=bank, sender=sender)
    heads = {name: value for name, value in trained.items() if name[0].isdigit()}
    again = evaluate_radio(config, 0, report=quiet, bank=bank, sender=sender, heads=heads)
    np.testing.assert_array_equal(again["greedy"], trained["greedy"])


# --- many senders
@pytest.fixture(scope="module")
def crowded():
    config = CrowdConfig(scouts=4, liar="elsewhere", scenes=300)
    return config, draw_crowd(LAYOUT, config, np.random.default_rng(0))


def test_one_scout_sees_the_slab_and_the_others_do_not(crowded):
    _, crowd = crowded
    camera, n = FastCamera(LAYOUT), len(crowd.slab)
    seen = np.stack(
        [hazard_pixels(camera, crowd.scouts[:, i], crowd.slab, crowd.navigator) > 0 for i in range(4)], axis=1
    )
    assert (seen.sum(1) == 1).all() and seen[np.arange(n), crowd.informed].all()
    assert set(crowd.informed) == set(range(4)) and (crowd.liar != crowd.informed).all()
    assert len(blind_poses(LAYOUT, 7, np.random.default_rng(0))) == 7


def test_a_liar_sends_what_another_scene_s_scout_sees_with_its_own_anchor(crowded, sender):
    _, crowd = crowded
    encoder, n = PictureEncoder(sender), len(crowd.slab)
    honest, lying = (
        crowd_messages(LAYOUT, encoder, crowd, state, 1, np.random.default_rng(0)) for state in (False, True)
    )
    wires = [each[:, EGO:-4].unflatten(1, (4, -1)) for each in (honest, lying)]
    torch.testing.assert_close(wires[0][..., :ANCHOR], wires[1][..., :ANCHOR])
    changed = (wires[0] != wires[1]).any(2).numpy()
    assert not changed[np.arange(n), crowd.informed].any() and changed.sum(1).max() == 1
    told = wires[0][np.arange(n), crowd.informed, ANCHOR:]
    lies = wires[1][np.arange(n), crowd.liar, ANCHOR:]
    assert all((told == lie).all(1).any() for lie in lies)
    assert changed[np.arange(n), crowd.liar].mean() > 0.9


def test_a_liar_needs_a_second_scout():
    with pytest.raises(ValidationError, match="a liar is a second scout"):
        CrowdConfig(scouts=1, liar="elsewhere")


def test_a_crowd_is_heard_and_a_liar_at_the_post_cannot_be_told_from_the_witness(sender):
    small = {"scenes": 1_024, "episodes": 3_000, "heads": 1, "held_out": 0.25}
    alone = train_crowd(CrowdConfig(scouts=2, **small), 0, report=quiet, sender=sender)
    assert alone["honest, honest"].mean() > 0.95 and set(alone) == {"honest, honest", "attention honest, honest"}
    lied = train_crowd(CrowdConfig(scouts=2, liar="at the post", **small), 0, report=quiet, sender=sender)
    assert abs(lied["lying, lying"].mean() - 0.75) < 0.1 and lied["honest, honest"].mean() > 0.95
