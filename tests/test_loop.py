"""The loop closed behind the surrogate camera: its eye, and heads and executors that meet it frozen."""

import numpy as np
import pytest
from pydantic import ValidationError

from lt_lib.beyond.loop import SimulatedEye, drive_behind, look, loop_draws, loop_heads, train_loop_heads
from lt_lib.beyond.loop_protocol import EYES, PLAIN, RANDOMISED, LoopProtocol
from lt_lib.beyond.variance import perfect_bank
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import HAZARD, INDEX
from lt_lib.hardware import optics
from lt_lib.hardware.eye import SurrogateEye
from lt_lib.hardware.surrogate import SurrogateScene
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.jepa import train_encoder
from lt_lib.pixels.episodes import Outcomes, drive
from lt_lib.pixels.executor import Executor, FrozenExecutor
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.settings.base import UserError
from lt_lib.settings.beyond import DrivingConfig, LoopHeadConfig, LoopSizes, SightConfig
from lt_lib.settings.hardware import OpticsConfig
from lt_lib.settings.perception import EncoderConfig
from lt_lib.store.states import state_of

LAYOUT = load_layout("matched")
PERFECT = OpticsConfig(
    distortion=0, vignetting=0, blur=0, exposure=0, balance=0, full_well=1e9, read_noise=0, mosaic=False, jpeg=100
)
POSES = np.array([[-1.8, 1.0, 0.1], [0.3, 0.5, 0.0], [1.8, 0.5, 0.0], [2.3, 0.1, np.pi - 0.2]])
OTHERS = np.array([[2.3, 0.0], [2.3, 0.0], [4.0, 0.3], [-3.0, 0.0]])
SLABS = np.array([0, 1, 1, 0])


def quiet(_: float) -> None:
    pass


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def encoder():
    return train_encoder(EncoderConfig(layout="matched", frames=640, epochs=0.0), 0, report=quiet)


@pytest.fixture(scope="module")
def executor():
    return {name.removeprefix("x."): value for name, value in state_of(Executor(), "x").items()}


# --- the eye
def test_the_eye_shows_what_the_fast_camera_shows_robot_and_goal_included():
    """Red, green and yellow lie where the simulator paints slab, goal and robot."""
    simulated = FastCamera(LAYOUT).frames(POSES, SLABS, OTHERS)
    seen = SurrogateEye(LAYOUT, PERFECT, "even", 0.0, rng()).frames(POSES, SLABS, OTHERS).astype(float)
    red, green, blue = np.moveaxis(seen, -1, 0)
    slab = (red > 2 * green) & (red > 2 * blue)
    goal = (green > 1.3 * red) & (green > 1.3 * blue)
    robot = (red > 2 * blue) & (green > 1.8 * blue)
    assert (slab == HAZARD[simulated]).mean() > 0.98 and slab[3].any()
    for name, there in {"goal": goal, "robot": robot}.items():
        truth = simulated == INDEX[name]
        assert truth.any() and (there == truth).mean() > 0.98


def test_the_rendered_crop_is_the_middle_of_the_whole_frame():
    config = OpticsConfig(blur=0, exposure=0, balance=0, full_well=1e9, read_noise=0, mosaic=False, jpeg=100)
    whole = SurrogateScene(LAYOUT, *optics.rendered_size(), optics.FOCAL * optics.OVERSAMPLING)
    picture = whole.sight(POSES[3], 0, OTHERS[3], "bright")
    expected = optics.crop(optics.expose(picture, config, optics.draw_shot(config, rng()), rng()))
    seen = SurrogateEye(LAYOUT, config, "bright", 0.0, rng()).frames(POSES[3:], SLABS[3:], OTHERS[3:])[0]
    assert np.abs(seen.astype(int) - expected).mean() < 1.5
    whole.close()


def test_lights_differ_and_every_frame_is_an_exposure_of_its_own():
    brightness = {}
    for light, stops in (("even", 0.0), ("bright", 0.0), ("dim", 1.0)):
        eye = SurrogateEye(LAYOUT, OpticsConfig(), light, stops, rng())
        first, second = (eye.frames(POSES, SLABS, OTHERS) for _ in range(2))
        assert (first != second).any((1, 2, 3)).all()
        brightness[light] = first[0].mean()  # on the near side, which the lamps do not reach
        eye.close()
    assert brightness["even"] > 2 * brightness["bright"] > 2 * brightness["dim"]


def test_a_scene_is_rendered_again_exactly_when_something_moves():
    eye = SurrogateEye(LAYOUT, PERFECT, "bright", 0.0, rng())
    still = eye.frames(POSES, SLABS, OTHERS)
    near = {"rtol": 0, "atol": 8}  # of what noise and JPEG leave
    np.testing.assert_allclose(eye.frames(POSES, SLABS, OTHERS), still, **near)
    for moved in (
        (POSES + [0.1, 0, 0], SLABS, OTHERS),
        (POSES, 1 - SLABS, OTHERS),
        (POSES, SLABS, OTHERS - [0.0, 0.2]),
    ):
        fresh = SurrogateEye(LAYOUT, PERFECT, "bright", 0.0, rng())
        np.testing.assert_allclose(eye.frames(*moved), fresh.frames(*moved), **near)
        assert np.abs(eye.frames(*moved).astype(int) - still).max() > 40
        fresh.close()
        eye.frames(POSES, SLABS, OTHERS)
    eye.close()


# --- driving, looking, reading
SIGHT = {"layout": "matched", "draws": 3, "optics": OpticsConfig(), "dim": 1.0}


def test_behind_the_simulated_eye_episodes_are_the_simulator_s(encoder, executor):
    more = {"driven": 3, "shards": 2, "rows": 4, "horizon": 30, "commit_step": 2}
    config = DrivingConfig(eye="simulated", **SIGHT, **more)
    shards = [drive_behind(config, s, report=quiet, encoder=encoder, executor=executor) for s in (0, 1)]
    assert [len(shard["length"]) for shard in shards] == [2, 1]
    entry, slab, route = (axis.ravel() for axis in np.indices((3, 2, 2)))
    expected = drive(
        Arena(LAYOUT, 4), FastCamera(LAYOUT), FrozenEncoder(encoder), FrozenExecutor(executor),
        loop_draws(config).of(entry), slab, route, 2, 30,
    )  # fmt: skip
    for name in Outcomes._fields:
        found = np.concatenate([shard[name] for shard in shards]).ravel()
        np.testing.assert_array_equal(found, getattr(expected, name))


def test_the_camera_changes_what_scouts_send_and_not_their_scenes(encoder):
    sights = {eye: look(SightConfig(eye=eye, **SIGHT), 0, report=quiet, encoder=encoder) for eye in EYES}
    shapes = {each["latents"].shape for each in sights.values()}
    assert shapes == {(3, 2, 64)} and all(each["pictures"].shape == (2, 64, 64, 3) for each in sights.values())
    drawn = loop_draws(SightConfig(eye="dim", **SIGHT))
    scout = np.repeat(drawn.scout[:1], 2, axis=0)
    frames = SimulatedEye(LAYOUT).frames(scout, np.arange(2), np.repeat(drawn.spawn[:1, :2], 2, axis=0))
    np.testing.assert_array_equal(sights["simulated"]["pictures"], frames)
    assert np.abs(sights["dim"]["latents"] - sights["simulated"]["latents"]).mean() > 0.1


def test_heads_learn_from_simulated_frames_whose_colours_are_random_or_not(encoder):
    bank = perfect_bank("matched", 64)
    small = {"layout": "matched", "scenes": 1_024, "episodes": 3_000, "heads": 1, "held_out": 0.25}
    for colours in ({}, {"colour": 0.5, "texture": 0.1}):
        found = train_loop_heads(LoopHeadConfig(**small, **colours), 0, report=quiet, bank=bank, encoder=encoder)
        assert found["greedy"].shape == (1, 256) and found["greedy"].mean() > 0.8
        assert len(loop_heads(found, 2)) == 1


def test_impossible_sizes_and_unknown_candidates_are_refused_in_one_line():
    with pytest.raises(ValidationError, match="expected shards <= driven <= draws, got 3, 20 and 10"):
        LoopSizes(draws=10, driven=20)
    pixels = PixelProtocol.of({}, "matched", "cpu", 1)
    with pytest.raises(UserError, match="candidate: unknown candidate 'paint'; known: half colour") as error:
        LoopProtocol.of({}, {}, {}, "paint", pixels)
    assert "\n" not in str(error.value)
    protocol = LoopProtocol.of({}, {}, {}, "full colour, texture", pixels)
    assert protocol.looks == {"colour": 1.0, "texture": 0.1}
    assert protocol._colours(PLAIN) == {"colour": 0.0, "texture": 0.0}
    assert protocol._colours(RANDOMISED) == protocol.looks
