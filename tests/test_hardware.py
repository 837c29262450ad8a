"""The hardware decode: optics in closed form, random floors and walls, sessions, real frames that are refused."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lt_lib.envs.camera import colours
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import HAZARD, INDEX, PALETTE
from lt_lib.hardware import capture, optics
from lt_lib.hardware.matched import select, train_matched_encoder
from lt_lib.hardware.placements import draw_placements, simulated_frames
from lt_lib.hardware.probe import decoded, fit_probe, frechet, placements_right, red_shares, transfer
from lt_lib.hardware.protocol import FILMED, HardwareProtocol, past_the_rails
from lt_lib.hardware.real_frames import read_sessions
from lt_lib.hardware.registration import GATES, RECORD, read_gates, registered_gates
from lt_lib.hardware.sessions import EFFECTS, Session, film_session, film_sweep, simulated_session, with_effect
from lt_lib.hardware.surrogate import SurrogateScene
from lt_lib.perception.appearance import NOT_RED, TEXTURED, draw_appearances, recoloured
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.frames import random_rollouts
from lt_lib.perception.pictures import PictureEncoder, colour_codes
from lt_lib.pixels.executor import Executor
from lt_lib.preflight import check_inputs
from lt_lib.settings.base import UserError
from lt_lib.settings.hardware import (
    BenchConfig,
    HardwareGates,
    MatchedEncoderConfig,
    OpticsConfig,
    RailsConfig,
    SessionConfig,
    SessionsConfig,
    SweepConfig,
)

LAYOUT = load_layout("matched")
PERFECT = OpticsConfig(
    distortion=0.0, vignetting=0.0, blur=0.0, exposure=0.0, balance=0.0, full_well=1e9, read_noise=0.0, mosaic=False,
    jpeg=100,
)  # fmt: skip
QUIET = BenchConfig(position=0.0, heading=0.0, clutter=0)
STEADY = optics.Shot(1.0, np.ones(3), np.zeros(2))
WIDTH, HEIGHT = optics.rendered_size()


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def nothing(_: float) -> None:
    """A run's report that nobody reads."""


def exposed(picture, shot=STEADY, seed=0, **changes):
    """The light that a frame of the camera stands for."""
    return optics.linear(optics.expose(picture, PERFECT.model_copy(update=changes), shot, rng(seed)))


def flat(level: int = 128):
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def dot(x: float, y: float):
    """A white disc of two pixels of the frame on black, its centre x, y pixels off the axis."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    near = np.hypot(u - optics.OVERSAMPLING * x, v - optics.OVERSAMPLING * y) < 2 * optics.OVERSAMPLING
    return np.repeat(255 * near[..., None], 3, axis=2).astype(np.uint8)


def centre_of(light):
    """Where the light of a frame is, pixels off the axis."""
    weight = light.sum(-1)
    u, v = np.meshgrid(
        np.arange(optics.WIDTH) + 0.5 - optics.WIDTH / 2, np.arange(optics.HEIGHT) + 0.5 - optics.HEIGHT / 2
    )
    return (u * weight).sum() / weight.sum(), (v * weight).sum() / weight.sum()


# --- the camera model


def test_the_crop_subtends_32_degrees_and_a_larger_frame_is_cropped_to_the_same_view():
    assert 2 * np.rad2deg(np.arctan(optics.CROP / 2 / optics.FOCAL)) == pytest.approx(32.0)
    frame = rng().integers(0, 256, (100, 140, 3)).astype(np.uint8)
    np.testing.assert_array_equal(optics.crop(frame), frame[18:82, 38:102])
    twice = np.kron(frame, np.ones((2, 2, 1), np.uint8))
    np.testing.assert_array_equal(optics.crop(twice, 128), optics.crop(frame))


def test_a_perfect_camera_shows_the_picture_and_gamma_is_undone_by_its_inverse():
    levels = np.arange(256, dtype=np.uint8)[:, None, None].repeat(3, 2)
    np.testing.assert_array_equal(optics.encoded(optics.linear(levels)), levels)
    frame = optics.expose(flat(90), PERFECT, STEADY, rng())
    assert frame.shape == (optics.HEIGHT, optics.WIDTH, 3)
    assert np.abs(frame.astype(int) - 90).max() <= 1


def test_a_barrel_moves_what_is_off_the_axis_inwards_by_the_stated_amount():
    k, seen = 0.4, 0.3  # the place in the frame, focal lengths
    true = seen * (1 + k * seen**2) * optics.FOCAL
    assert centre_of(exposed(dot(true, 0)))[0] == pytest.approx(true, abs=0.2)
    x, y = centre_of(exposed(dot(true, 0), distortion=k))
    assert (x, y) == (pytest.approx(seen * optics.FOCAL, abs=0.2), pytest.approx(0, abs=0.1))


def test_vignetting_takes_its_share_in_the_corner_and_nothing_in_the_middle():
    light, dark = exposed(flat()), exposed(flat(), vignetting=0.5)
    assert dark[60, 80].mean() == pytest.approx(light[60, 80].mean(), rel=0.02)
    assert dark[0, 0].mean() == pytest.approx(light[0, 0].mean() / 2, rel=0.05)
    middle = (optics.WIDTH / 2) ** 2 / ((optics.WIDTH / 2) ** 2 + (optics.HEIGHT / 2) ** 2)  # of the corner's r^2
    assert dark[60, 0].mean() == pytest.approx(light[60, 0].mean() * (1 - 0.5 * middle), rel=0.05)


def test_exposure_and_balance_are_factors_on_the_light():
    shot = optics.Shot(2.0, np.array([0.5, 1.0, 1.25]), np.zeros(2))
    ratio = exposed(flat(80), shot).mean((0, 1)) / exposed(flat(80)).mean((0, 1))
    np.testing.assert_allclose(ratio, [1.0, 2.0, 2.5], rtol=0.03)
    shots = [optics.draw_shot(OpticsConfig(exposure=0.5, balance=0.1, blur=3.0), rng(s)) for s in range(400)]
    assert np.std(np.log2([s.exposure for s in shots])) == pytest.approx(0.5, rel=0.1)
    assert np.std(np.log([s.balance[0] for s in shots])) == pytest.approx(0.1, rel=0.1)
    assert {round(float(np.hypot(*s.blur)), 6) for s in shots} == {3.0}


def test_motion_blur_spreads_light_along_the_motion_alone_and_keeps_it():
    sharp, moved = exposed(dot(0, 0)), exposed(dot(0, 0), optics.Shot(1.0, np.ones(3), np.array([12.0, 0.0])))
    assert moved.sum() == pytest.approx(sharp.sum(), rel=0.05)
    variance = [((np.arange(size) + 0.5 - size / 2) ** 2) for size in (optics.WIDTH, optics.HEIGHT)]
    along, across = (
        [(each.sum((2, 1 - axis)) * v).sum() / each.sum() for each in (sharp, moved)]
        for axis, v in ((1, variance[0]), (0, variance[1]))
    )
    assert along[1] - along[0] == pytest.approx(12.0**2 / 12, rel=0.1)  # of a uniform motion
    assert across[1] == pytest.approx(across[0], rel=0.1)


def test_shot_noise_is_poisson_s_and_read_noise_adds_its_square():
    weights = np.array([0.299, 0.587, 0.114])  # of the luminance, which JPEG keeps at full resolution
    light = optics.linear(flat(188)[:1, :1]).item(0)
    slope = 255 * 1.055 / 2.4 * light ** (1 / 2.4 - 1)  # grey levels for light
    for read_noise in (0.0, 12.0):
        camera = PERFECT.model_copy(update={"full_well": 200.0, "read_noise": read_noise})
        luminance = optics.expose(flat(188), camera, STEADY, rng()) @ weights
        expected = (light / 200 + (read_noise / 200) ** 2) * slope**2 * (weights @ weights)
        assert luminance.var() == pytest.approx(expected, rel=0.1)


def test_the_mosaic_keeps_flat_colours_and_blurs_edges_and_low_jpeg_quality_costs_detail():
    edge = flat(30)
    edge[:, WIDTH // 2 + 1 :] = (220, 40, 40)
    perfect, mosaic, poor = exposed(edge), exposed(edge, mosaic=True), exposed(edge, jpeg=5)
    error = np.abs(mosaic - perfect).max(-1)
    assert error[:, 90:158].max() < 0.02 and error[:, 77:84].max() > 0.05
    assert np.abs(mosaic - perfect)[60, 120, 0] < 0.02  # red is still the first channel
    assert np.abs(poor - perfect).mean() > 3 * np.abs(exposed(edge, jpeg=90) - perfect).mean()


# --- the bench and its surrogate


def test_the_label_says_what_the_crop_shows():
    config = SessionConfig(hazard=150, clear=150)
    placements = draw_placements(LAYOUT, config, rng())
    share = HAZARD[simulated_frames(LAYOUT, placements)].mean(axis=(1, 2))
    assert share[placements.hazard].min() > 0.2
    assert share[~placements.hazard].max() == 0


def test_a_session_has_its_counts_marks_and_lighting():
    config = SessionConfig(hazard=7, clear=5, near=120, far=240, marks=4, lighting=["bright", "dim"])
    placements = draw_placements(LAYOUT, config, rng())
    assert (placements.hazard.sum(), (~placements.hazard).sum()) == (7, 5)
    assert sorted(set(placements.distance.round(6))) == [1.2, 1.6, 2.0, 2.4]
    assert placements.dim.sum() == placements.side.sum() == 6
    exact = draw_placements(LAYOUT, config.model_copy(update={"bench": QUIET}), rng())
    front = LAYOUT.routes[0].slab.x[1]
    np.testing.assert_allclose(exact.eye[:, 0] - front, exact.distance)
    with pytest.raises(ValueError, match="near must be below far, got 200.0 and 120.0 cm"):
        SessionConfig(near=200, far=120)


def test_the_surrogate_shares_the_layout_s_geometry_with_the_fast_camera():
    config = SessionConfig(hazard=2, clear=1, bench=QUIET, lighting=["bright"])
    placements = draw_placements(LAYOUT, config, rng(1))._replace(slab_offset=np.zeros((3, 3)))
    scene = SurrogateScene(LAYOUT, WIDTH, HEIGHT, optics.FOCAL * optics.OVERSAMPLING)
    for i, simulated in enumerate(simulated_frames(LAYOUT, placements)):
        picture = scene.picture(placements, i, 0)
        frame = optics.crop(optics.expose(picture, PERFECT, STEADY, rng())).astype(float)
        red = frame[..., 0] > 2 * frame[..., 1:].max(-1)
        assert (red == HAZARD[simulated]).mean() > 0.98
    scene.close()


def test_a_dim_placement_is_darker_and_warmer_and_clutter_is_where_it_was_asked_for():
    config = SessionConfig(hazard=1, clear=1, bench=QUIET, lighting=["dim"])
    placements = draw_placements(LAYOUT, config, rng(2))
    lit = placements._replace(dim=np.zeros(2, bool))
    scene = SurrogateScene(LAYOUT, WIDTH, HEIGHT, optics.FOCAL * optics.OVERSAMPLING)
    dark, bright, cluttered = scene.picture(placements, 0, 0), scene.picture(lit, 0, 0), scene.picture(lit, 0, 12)
    scene.close()
    red, _, blue = dark[HEIGHT // 2 :].mean((0, 1)) / bright[HEIGHT // 2 :].mean((0, 1))
    assert blue < red < 1
    assert (cluttered != bright).any(-1).mean() > 0.02


def test_the_dim_state_turns_the_light_down_by_its_stops():
    config = SessionConfig(hazard=1, clear=1, shots=1, optics=PERFECT, lighting=["dim"])
    full, quarter = (film_session(with_effect(config, "dim", stops), 0, report=nothing) for stops in (0.0, 2.0))
    ratio = optics.linear(full["frames"][0]).mean() / optics.linear(quarter["frames"][0]).mean()
    assert ratio == pytest.approx(4, rel=0.1)


def test_a_session_is_filmed_alike_from_one_seed_and_cut_to_its_frames():
    config = SessionConfig(hazard=1, clear=2, shots=2, frames=5)
    first, again = (film_session(config, 3, report=nothing) for _ in range(2))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert first["frames"].shape == (5, 64, 64, 3)
    assert first["placement"].tolist() == [0, 0, 1, 1, 2]
    assert all(len(set(first[name][first["placement"] == 0])) == 1 for name in ("hazard", "dim", "distance"))
    assert (first["frames"][0] != first["frames"][1]).any()  # the noise is new, the placement is not


def test_a_sweep_changes_one_thing_on_the_same_placements():
    bench = BenchConfig(position=0.0, heading=0.0)
    config = SweepConfig(effect="clutter", hazard=2, clear=1, shots=1, bench=bench, optics=PERFECT, lighting=["bright"])
    sweep = film_sweep(config, 0, report=nothing)
    assert sweep["frames"].shape == (5, 3, 64, 64, 3)
    for frames in sweep["frames"]:
        assert ((red_shares(frames, 1.5) > 0.15) == sweep["hazard"]).all()
    emptier, fuller = (sweep["frames"][i].astype(int) for i in (0, 4))
    assert 0 < np.abs(fuller - emptier).mean() < np.abs(fuller - emptier[[1, 2, 0]]).mean() / 2  # the same placements
    for effect, (_, strengths) in EFFECTS.items():
        changed = [with_effect(SessionConfig(), effect, s) for s in strengths]
        assert len(set(changed)) == len(strengths)
        assert with_effect(changed[0], effect, strengths[-1]) == changed[-1]
        assert SessionConfig() in changed  # the nominal strength is one of them
    with pytest.raises(UserError, match="unknown effect 'rain'; known: distortion, "):
        with_effect(SessionConfig(), "rain", 1.0)


# --- the encoder at matched optics


def test_floor_and_walls_are_recoloured_as_a_slow_loop_does_and_nothing_else_is():
    frames = random_rollouts(LAYOUT, 6, 1, rng(3)).frames[:, 0]
    looks = draw_appearances(6, 64, 1.0, 0.2, rng(4))
    quick = recoloured(frames, looks)
    for b, y, x in rng(5).integers(0, (6, 64, 64), (300, 3)):
        index = frames[b, y, x]
        gain = 1 + looks.textures[b, y, x] if TEXTURED[index] else 1.0
        np.testing.assert_allclose(quick[b, y, x], np.clip(looks.palettes[b, index] * gain, 0, 1), atol=1e-6)
    kept = [name for name in INDEX if not name.startswith(("floor", "wall", "barrier"))]
    assert [name for name in INDEX if not TEXTURED[INDEX[name]]] == kept
    own = colours(frames) / 255
    untouched = ~TEXTURED[frames]
    np.testing.assert_allclose(quick[untouched], own[untouched], atol=1e-6)
    np.testing.assert_allclose(recoloured(frames, draw_appearances(6, 64, 0.0, 0.0, rng(6))), own, atol=1e-6)


def test_no_floor_and_no_wall_is_as_red_as_the_slab():
    palettes = draw_appearances(2_000, 8, 1.0, 0.0, rng(7)).palettes[:, TEXTURED]
    assert (palettes[..., 0] <= NOT_RED * palettes[..., 1:].max(-1) + 1e-6).all()
    assert palettes.std(axis=0).min() > 0.15  # yet every colour moves
    slab = PALETTE[HAZARD].astype(float)
    assert (slab[:, 0] > NOT_RED * slab[:, 1:].max(1)).all()


def test_colour_codes_are_the_quantised_colours_of_the_cells_centres():
    picture = rng(8).random((2, 64, 64, 3)).astype(np.float32)
    codes = colour_codes(picture)
    for b, i, j in np.ndindex(2, 16, 16):
        red, green, blue = np.floor(picture[b, 4 * i + 2, 4 * j + 2] * 4)
        assert codes[b, i, j] == 16 * red + 4 * green + blue


TINY = MatchedEncoderConfig(frames=256, rollout=8, epochs=2.0, batch=32, colour=1.0, texture=0.1)


@pytest.fixture(scope="module")
def trained():
    return train_matched_encoder(TINY, 0, report=nothing)


def test_training_is_pure_lowers_the_loss_and_serves_pictures_and_palette_frames_alike(trained):
    again = train_matched_encoder(TINY, 0, report=nothing)
    assert all(np.array_equal(trained[name], again[name]) for name in trained)
    assert trained["loss.reconstruction"][-3:].mean() < 0.985 * trained["loss.reconstruction"][:3].mean()
    frames = random_rollouts(LAYOUT, 20, 1, rng(9)).frames[:, 0]
    pictures = PictureEncoder(trained).latents(colours(frames))
    np.testing.assert_allclose(pictures, FrozenEncoder(trained).latent(frames).numpy(), atol=1e-4)


def gates(**changes) -> HardwareGates:
    return read_gates().model_copy(update=changes)


def test_the_best_candidate_that_passes_every_gate_is_selected():
    shown = {
        "narrow": {"hazard": 0.99, "walls": 0.9, "rank": 10.0},
        "good": {"hazard": 0.95, "walls": 0.9, "rank": 40.0},
        "fair": {"hazard": 0.92, "walls": 0.95, "rank": 50.0},
    }
    assert select(shown, gates(hazard=0.9, walls=0.85, rank=32.0)) == "good"
    with pytest.raises(UserError, match="no encoder candidate passed the gates; the best, 'narrow', reached"):
        select(shown, gates(hazard=0.9, walls=0.85, rank=60.0))


def test_rails_count_components_beyond_one_by_route_and_axis(trained):
    policy = Executor()
    weights = {name: np.zeros_like(value.numpy()) for name, value in policy.state_dict().items()}
    weights["mean.4.bias"] = np.array([1.01, -3.0, 0.99], np.float32)  # whatever it sees
    past = past_the_rails(RailsConfig(rollouts=2, length=2), trained, weights)
    assert past.tolist() == [[1, 1, 0], [1, 1, 0]]


# --- probe and statistics


def test_the_probe_has_65_parameters_and_its_threshold_is_its_bias():
    latents = rng(10).normal(size=(400, 64))
    hazard = latents[:, 3] - 0.5 * latents[:, 7] > 0.2
    probe = fit_probe(latents, hazard)
    assert probe.parameters == 65
    assert ((probe.scores(latents) > 0) == hazard).mean() > 0.95
    assert decoded(np.array([0.1, -0.1, 2.0, -2.0]), np.array([True, False, True, False])) == (1.0, 1.0)
    moved = probe._replace(bias=probe.bias + 50)
    assert (moved.scores(latents) > 0).all()


def test_a_shift_spares_the_direction_and_costs_the_operating_point():
    latents = rng(11).normal(size=(300, 64))
    hazard = latents[:, 0] > 0
    session = Session(np.zeros((300, 64, 64, 3), np.uint8), hazard, np.arange(300), np.ones(300), np.zeros(300, bool))

    class Shifted(PictureEncoder):
        """An encoder whose camera adds a constant."""

        def __init__(self):
            self.shifts = iter([0.0, 20.0, 20.0])

        def latents(self, _):
            return latents + next(self.shifts)

    both = transfer(Shifted(), session, {"refit": session, "live": session})
    assert both.decoded(both.simulated, "simulated").balanced > 0.95
    shifted = both.decoded(both.simulated, "live")
    assert shifted.auc > 0.95 and shifted.balanced == 0.5
    assert both.decoded(both.refit, "live").balanced > 0.95 and both.right(both.refit, "live").mean() > 0.95


def test_frechet_distance_of_known_gaussians():
    one = rng(12).normal(size=(4_000, 5))
    assert frechet(one, one) == pytest.approx(0, abs=1e-6)
    assert frechet(one, one + 2.0) == pytest.approx(4 * 5)
    assert frechet(one, 3 * one) == pytest.approx(
        4 * np.trace(np.cov(one, rowvar=False)) + 4 * (one.mean(0) ** 2).sum()
    )


def test_a_placement_is_right_when_all_of_its_decisions_are():
    right = np.array([True, True, True, False, True, True])
    assert placements_right(right, np.array([4, 4, 7, 7, 9, 9])) == (2, 3)


def test_the_red_rule_counts_pixels_redder_than_the_ratio():
    frame = np.zeros((1, 64, 64, 3), np.uint8)
    frame[0, :16] = (150, 90, 99)
    frame[0, 16:32] = (150, 90, 101)
    assert red_shares(frame, 1.5)[0] == 0.25


# --- registered gates


def test_a_gate_file_that_changed_after_the_first_use_is_told(tmp_path):
    gates_file, outputs = tmp_path / "hardware.yaml", tmp_path / "outputs"
    shutil.copy(GATES, gates_file)
    _, first = registered_gates(outputs, gates_file)
    assert not first.changed and "unchanged" in str(first) and (outputs / RECORD).exists()
    assert registered_gates(outputs, gates_file)[1] == first
    gates_file.write_text(gates_file.read_text().replace("decode: 0.95", "decode: 0.5"))
    _, second = registered_gates(outputs, gates_file)
    assert second.changed and second.registered == first.digest != second.digest
    assert "CHANGED AFTER THE FACT" in str(second)
    gates_file.write_text("decode: high")
    with pytest.raises(UserError, match=r"^hardware.yaml.candidates: Field required"):
        registered_gates(outputs, gates_file)


# --- real frames

ROOM = TINY.model_copy(update={"colour": 0.0, "texture": 0.0})  # one room, as a real one
SMALL = SessionsConfig(
    refit=SessionConfig(hazard=5, clear=5), validation=SessionConfig(hazard=4, clear=4),
    live=SessionConfig(hazard=4, clear=4),
)  # fmt: skip


def write_folder(folder: Path) -> Path:
    """A tiny folder as a robot would leave it: simulated frames, larger than the crop, with some noise."""
    folder.mkdir()
    lines = ["file,session,placement,distance_cm,lighting,hazard"]
    for name, seed in FILMED.items():
        session = simulated_session(getattr(SMALL, name), ROOM, seed)
        for i, frame in enumerate(session.frames):
            whole = rng(100 * seed + i).integers(0, 256, (140, 180, 3))
            whole[6:134, 26:154] = np.kron(frame, np.ones((2, 2, 1)))
            noisy = np.clip(whole + rng(seed).normal(0, 4, whole.shape), 0, 255).astype(np.uint8)
            file = f"{name}_{i}.{'png' if i % 2 else 'jpg'}"
            Image.fromarray(noisy).save(folder / file, quality=95)
            light = "dim" if session.dim[i] else "bright"
            lines.append(f"{file},{name},{i},{session.distance[i]:.0f},{light},{int(session.hazard[i])}")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    (folder / "optics.yaml").write_text("crop: 128\n")
    return folder


@pytest.fixture(scope="module")
def good_folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("real") / "frames")


@pytest.fixture
def folder(good_folder, tmp_path):
    return Path(shutil.copytree(good_folder, tmp_path / "frames"))


def test_a_real_folder_is_read_cropped_and_decoded_end_to_end(good_folder, trained):
    check_inputs(inputs(good_folder))
    sessions = read_sessions(good_folder)
    assert [len(sessions[name].hazard) for name in FILMED] == [10, 8, 8]
    for name, seed in FILMED.items():
        source = simulated_session(getattr(SMALL, name), ROOM, seed)
        assert np.abs(sessions[name].frames.astype(int) - source.frames).mean() < 8  # the crop is in the right place
        assert sessions[name].hazard.tolist() == source.hazard.tolist()
        assert sessions[name].dim.tolist() == source.dim.tolist()
    simulated = simulated_session(SessionConfig(hazard=100, clear=100), TINY, 9)
    both = transfer(PictureEncoder(trained), simulated, sessions)
    assert both.decoded(both.refit, "live").balanced >= 0.85
    assert both.right(both.refit, "live").shape == (8,)


def inputs(folder: Path) -> dict:
    """What run_all.py checks before it starts the notebook."""
    return {"frames": str(folder), "effects": ["blur"], "gate_file": "params/gates/hardware.yaml"}


def edited(old: str, new: str, row: int | None = None):
    """Changes the text of labels.csv, or of one of its rows."""

    def change(folder: Path) -> None:
        lines = (folder / "labels.csv").read_text().splitlines()
        chosen = range(len(lines)) if row is None else [row - 1]
        for i in chosen:
            assert old in lines[i]
            lines[i] = lines[i].replace(old, new)
        (folder / "labels.csv").write_text("\n".join(lines) + "\n")

    return change


def read_hazard(folder: Path, row: int) -> str:
    """How a row of labels.csv ends: its answer."""
    return (folder / "labels.csv").read_text().splitlines()[row - 1][-2:]


def truncated(folder: Path, file: str) -> None:
    path = folder / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def saved_again(folder: Path) -> None:
    """A live frame that is a refit frame, as another JPEG."""
    Image.open(folder / "refit_1.png").save(folder / "live_0.jpg", quality=97)


BAD = {
    "missing file": (lambda f: (f / "refit_3.png").unlink(), r"labels.csv row 5: refit_3.png is missing"),
    "unknown session": (edited("live", "lunch", 20), r"labels.csv row 20: unknown session 'lunch'; known: refit, "),
    "unknown lighting": (edited("bright", "sunny", 2), r"labels.csv row 2: unknown lighting 'sunny'"),
    "unknown hazard": (lambda f: edited(read_hazard(f, 4), ",yes", 4)(f), r"labels.csv row 4: unknown hazard 'yes'"),
    "no placement": (edited(",2,", ",two,", 4), r"labels.csv row 4: placement must be a whole number"),
    "no distance": (edited(",bright", "cm,bright", 2), r"labels.csv row 2: distance_cm must be a distance in cm"),
    "short row": (edited(",bright", "", 2), r"labels.csv row 2: expected 6 values"),
    "columns": (edited("distance_cm", "distance", 1), r"labels.csv row 1: expected the columns file,session,"),
    "a file twice": (edited("refit_1.png", "refit_0.jpg", 3), r"labels.csv row 3: refit_0.jpg is there twice"),
    "wrong size": (
        lambda f: Image.new("RGB", (320, 240)).save(f / "refit_2.jpg"),
        r"labels.csv row 4: refit_2.jpg is 320 x 240 pixels, the first is 180 x 140",
    ),
    "smaller than the crop": (
        lambda f: (f / "optics.yaml").write_text("crop: 150\n"),
        r"labels.csv row 2: refit_0.jpg is 180 x 140 pixels, smaller than the crop of 150 x 150",
    ),
    "no image": (lambda f: (f / "refit_1.png").write_text("hello"), r"labels.csv row 3: refit_1.png is no image"),
    "truncated png": (lambda f: truncated(f, "refit_1.png"), r"labels.csv row 3: refit_1.png is truncated or damaged"),
    "truncated jpeg": (lambda f: truncated(f, "refit_2.jpg"), r"labels.csv row 4: refit_2.jpg is truncated or damaged"),
    "copied across sessions": (
        lambda f: shutil.copy(f / "refit_1.png", f / "validation_1.png"),
        r"row 13: validation_1.png \(validation\) is the same frame as refit_1.png in row 3 \(refit\)",
    ),
    "saved again across sessions": (saved_again, r"row 20: live_0.jpg \(live\) is the same frame as refit_1.png"),
    "no labels": (lambda f: (f / "labels.csv").unlink(), r"labels.csv is missing; it has the columns"),
    "no rows": (lambda f: (f / "labels.csv").write_text("file,session,placement,distance_cm,lighting,hazard\n"),
                r"labels.csv has no rows"),
    "no optics": (lambda f: (f / "optics.yaml").unlink(), r"optics.yaml is missing; it states 'crop"),
    "odd optics": (lambda f: (f / "optics.yaml").write_text("crop: wide"), r"optics.yaml: expected one line 'crop"),
    "neither png nor jpeg": (edited("refit_0.jpg", "refit_0.gif", 2), r"labels.csv row 2: 'refit_0.gif' is neither"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_folder_gives_one_clear_line_with_its_row_before_anything_runs(case, folder):
    spoil, line = BAD[case]
    spoil(folder)
    with pytest.raises(UserError, match=line) as caught:
        check_inputs(inputs(folder))
    assert "\n" not in str(caught.value)


def test_an_unknown_effect_and_a_missing_gate_file_are_told_before_anything_runs(good_folder):
    with pytest.raises(UserError, match="effects: unknown camera effect 'rain'; known: distortion, "):
        check_inputs(inputs(good_folder) | {"effects": ["blur", "rain"]})
    with pytest.raises(UserError, match="^none.yaml: cannot be read"):
        check_inputs(inputs(good_folder) | {"gate_file": "params/gates/none.yaml"})


def test_a_session_without_both_answers_is_refused(folder):
    path = folder / "labels.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not (",live," in line and line.endswith(",1"))) + "\n")
    with pytest.raises(UserError, match="session live needs frames with hazard 1 and with hazard 0"):
        read_sessions(folder)


# --- the capture script


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> str:
    path = str(tmp_path_factory.mktemp("video") / "walk.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 120))
    for level in range(40):
        writer.write(np.full((120, 160, 3), (5 * level, 0, 255 - 5 * level), np.uint8))  # blue rises, red falls
    writer.release()
    return path


def shoot(folder: Path, video: str, **changes) -> int:
    options = {"crop": 100, "session": "refit", "placement": 1, "distance": 150, "lighting": "bright", "hazard": 1,
               "shots": 2, "skip": 9, "source": video} | changes  # fmt: skip
    return capture.main([str(folder), *(text for k, v in options.items() for text in (f"--{k}", str(v)))])


def test_a_video_becomes_a_folder_that_the_notebook_reads(video, tmp_path, capsys):
    for placement, (session, hazard) in enumerate([(s, h) for s in FILMED for h in (0, 1)]):
        assert shoot(tmp_path, video, session=session, placement=placement, hazard=hazard, skip=3 + 3 * placement) == 0
    assert "2 frames: refit_000_1.png, refit_000_2.png" in capsys.readouterr().out
    sessions = read_sessions(tmp_path)
    assert sessions["live"].placement.tolist() == [4, 4, 5, 5]
    assert sessions["live"].hazard.tolist() == [False, False, True, True]
    red, _, blue = sessions["refit"].frames[0].mean((0, 1))
    assert (red, blue) == (pytest.approx(240, abs=4), pytest.approx(15, abs=4))  # frame 3, RGB


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"source": "nothing.avi"}, "--source nothing.avi: no camera and no video that OpenCV can open"),
        ({"shots": 0}, "--shots must be 1 or more, got 0"),
        ({"distance": "nan"}, "--distance must be 0 or more, got nan"),
        ({"skip": 30}, "ended after 1 of 2 shots; take fewer, or skip fewer"),
        ({"crop": 130}, "--crop 130 must lie between 64 and the frame's 120 pixels"),
        ({"crop": 90, "placement": 2}, "--crop 90: "),
        ({}, "--placement 1: session refit already has it; take a new number"),
    ],
)
def test_the_capture_script_refuses_and_writes_nothing(changes, line, video, tmp_path, capsys):
    if changes.get("crop") == 90 or not changes:
        assert shoot(tmp_path, video) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert shoot(tmp_path, video, **changes) == 2
    assert line in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_protocol_takes_real_frames_in_the_surrogate_s_place(good_folder):
    protocol = HardwareProtocol.of(
        read_gates(),
        1,
        "cpu",
        str(good_folder),
        10,
        matched={},
        cheap={},
        checks={},
        sessions={},
        executor={},
        rails={},
    )
    filmed = protocol.filmed()  # at once: nothing is rendered
    assert {name: len(session.hazard) for name, session in filmed.items()} == {"refit": 10, "validation": 8, "live": 8}
