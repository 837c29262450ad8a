"""The freeze: gates that can fail, weights that are refused when they are not what they should be."""

import json

import numpy as np
import pytest
import torch

from lt_lib.envs.camera import network_input
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import PALETTE
from lt_lib.perception.encoder import Encoder, FrozenEncoder, architecture
from lt_lib.perception.frames import hazard_visible, random_rollouts
from lt_lib.perception.gates import GateError, effective_rank, encode, require_gates
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.weights import load_frozen, save_frozen
from lt_lib.preflight import check_inputs, settled
from lt_lib.settings.base import UserError
from lt_lib.settings.perception import EncoderConfig, Gates
from lt_lib.store.files import content_digest
from lt_lib.store.states import restored

PASSED = {"hazard": 0.95, "majority": 0.8, "walls": 0.97, "rank": 50.0}


@pytest.fixture(scope="module")
def trained():
    config = EncoderConfig(frames=256, rollout=8, epochs=1.0, batch=32)
    return train_encoder(config, 0, report=lambda _: None)


def test_effective_rank_counts_the_directions_that_are_used():
    rng = np.random.default_rng(0)
    white = np.linalg.qr(rng.normal(size=(500, 8)) - 0.0)[0]
    white = np.linalg.qr(white - white.mean(0))[0]  # centred, orthonormal: eight equal singular values
    assert effective_rank(white) == pytest.approx(8)
    assert effective_rank(np.outer(rng.normal(size=500), np.ones(8))) == pytest.approx(1)
    two = white * np.array([1, 1, 0, 0, 0, 0, 0, 0])
    assert effective_rank(two) == pytest.approx(2)
    uneven = white[:, :2] * np.array([3.0, 1.0])  # shares 3/4 and 1/4; as eigenvalues 9/10 and 1/10
    for power, share in ((1, 0.75), (2, 0.9)):
        entropy = -share * np.log(share) - (1 - share) * np.log(1 - share)
        assert effective_rank(uneven, power) == pytest.approx(np.exp(entropy))


@pytest.mark.parametrize(
    ("found", "complaint"),
    [
        ({"hazard": 0.9}, "linear hazard-visible probe 0.900 is 0.035 short of 0.935"),
        ({"majority": 0.99}, "linear hazard-visible probe 0.950 is 0.040 short of 0.990"),
        ({"walls": 0.5}, "wall-count R^2 0.500 is 0.450 short of 0.950"),
        ({"rank": 4.25}, "effective rank 4.250 is 35.750 short of 40.000"),
        ({"rank": float("nan")}, "effective rank nan"),
    ],
)
def test_a_failed_gate_is_named_with_its_shortfall(found, complaint):
    require_gates(PASSED, Gates())
    with pytest.raises(GateError, match=complaint.replace("^", r"\^")):
        require_gates(PASSED | found, Gates())


def test_training_is_a_pure_function_that_lowers_the_loss_and_fixes_the_normalisation(trained):
    again = train_encoder(EncoderConfig(frames=256, rollout=8, epochs=1.0, batch=32), 0, report=lambda _: None)
    assert all(np.array_equal(trained[name], again[name]) for name in trained)
    frames = random_rollouts(load_layout("default"), 32, 8, np.random.default_rng([0, 0])).frames  # those of its seed
    latents = encode(FrozenEncoder(trained), frames).reshape(-1, 64)
    np.testing.assert_allclose(latents.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(latents.std(0, ddof=1), 1, atol=1e-2)
    longer = train_encoder(EncoderConfig(frames=256, rollout=8, epochs=12.0, batch=32), 0, report=lambda _: None)
    assert longer["loss.reconstruction"][-5:].mean() < 0.8 * longer["loss.reconstruction"][:5].mean()


def test_architecture_is_the_paper_s():
    assert architecture(Encoder()) == "conv 32,64,64 kernels 8,4,3 strides 4,2,1 linear 64"


def test_the_first_layer_by_tables_equals_torch_s_on_rendered_frames_and_on_noise(trained):
    rng = np.random.default_rng(1)
    rendered = random_rollouts(load_layout("default"), 32, 2, rng).frames[:, 0]
    noise = rng.integers(0, len(PALETTE), rendered.shape).astype(np.uint8)  # no run is longer than a few pixels
    plain = np.repeat(np.arange(len(PALETTE), dtype=np.uint8), 64 * 64).reshape(-1, 64, 64)  # every window one colour
    encoder, frozen = restored(Encoder(), trained, "E"), FrozenEncoder(trained)
    for frames in (rendered, noise, plain):
        with torch.no_grad():
            expected = encoder.layers[:2](torch.from_numpy(network_input(frames)).permute(0, 3, 1, 2))
        torch.testing.assert_close(frozen.inputs(frames), expected, atol=1e-5, rtol=1e-5)
    alone = torch.cat([frozen.inputs(rendered[i : i + 1]) for i in range(4)])
    assert torch.equal(alone, frozen.inputs(rendered[:4]))  # whatever is computed beside a frame


def test_bfloat16_latents_stay_near_the_reference(trained):
    frames = random_rollouts(load_layout("default"), 64, 2, np.random.default_rng(1)).frames[:, 0]
    reference, fast = (FrozenEncoder(trained, precision=p).latent(frames) for p in ("float32", "bfloat16"))
    assert ((fast - reference).norm(dim=1) / reference.norm(dim=1)).median() < 0.03


def test_rollouts_show_the_hazard_sometimes_and_robots_never_stand_in_walls():
    layout = load_layout("default")
    rollouts = random_rollouts(layout, 100, 3, np.random.default_rng(2))
    assert 0.05 < hazard_visible(rollouts.frames).mean() < 0.6
    assert layout.free(rollouts.poses[:, 0, 0], rollouts.poses[:, 0, 1], layout.robot.radius).all()


def test_weights_come_back_as_they_were_frozen(trained, tmp_path):
    layout = load_layout("default")
    save_frozen(tmp_path, "encoder", trained, layout, {"settings": {}})
    back = load_frozen(tmp_path, "encoder", layout)
    assert back.keys() == trained.keys() and all(np.array_equal(back[k], trained[k]) for k in back)


def edit(path, **changes):
    """Changes a sidecar as if it had been frozen so."""
    sidecar = json.loads(path.read_text()) | changes
    sidecar["sidecar_sha256"] = content_digest({name: sidecar[name] for name in sidecar if name != "sidecar_sha256"})
    path.write_text(json.dumps(sidecar))


def flip(path, place):
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (
            lambda f: (f / "encoder.safetensors").unlink(),
            "encoder.safetensors is missing; give a folder that holds",
        ),
        (lambda f: (f / "encoder.json").unlink(), "encoder.json is missing; give a folder that holds"),
        (lambda f: (f / "encoder.json").write_text("{}"), "is not a sidecar of frozen weights"),
        (lambda f: (f / "encoder.json").write_text("not json"), "is not a sidecar of frozen weights"),
        (lambda f: (f / "encoder.safetensors").write_bytes(b"\0" * 100), "is truncated or altered"),
        (lambda f: (f / "encoder.safetensors").write_bytes(b""), "is truncated or altered"),
        (lambda f: flip(f / "encoder.safetensors", -1), "is truncated or altered"),
        (lambda f: flip(f / "encoder.safetensors", 100), "is truncated or altered"),
        (lambda f: flip(f / "encoder.json", (f / "encoder.json").read_bytes().index(b"0.97") + 3), "was altered"),
        (lambda f: edit(f / "encoder.json", kind="executor"), "holds kind executor, format 2; expected kind encoder"),
        (lambda f: edit(f / "encoder.json", format=9), "format 9; expected kind encoder, format 2"),
        (
            lambda f: edit(f / "encoder.json", layout=load_layout("leaking").model_dump(mode="json")),
            "was trained in a scene other than layout 'default'",
        ),
    ],
)
def test_weights_that_are_not_what_they_should_be_are_refused_in_one_line(trained, tmp_path, spoil, complaint):
    layout = load_layout("default")
    save_frozen(tmp_path, "encoder", trained, layout, {"hazard": 0.97})
    spoil(tmp_path)
    with pytest.raises(UserError, match="^weights: ") as refused:
        load_frozen(tmp_path, "encoder", layout)
    assert complaint in str(refused.value) and "\n" not in str(refused.value)


def test_preflight_refuses_what_the_notebooks_would_only_find_later(tmp_path):
    check_inputs({"layout": "default", "weights": "", "seeds": {"latent": 2}})
    for inputs, complaint in (
        ({"layout": "maze"}, "unknown layout 'maze'; known: corridors_2"),
        ({"layout": "leaking"}, "the navigator sees the"),
        ({"layout": "default", "weights": str(tmp_path)}, "encoder.safetensors is missing"),
        ({"seeds": {"smoke signals": 2}}, "unknown message condition 'smoke signals'; known: latent"),
    ):
        with pytest.raises(UserError, match=complaint):
            check_inputs(inputs)


def test_only_a_profile_that_was_never_run_leaves_its_weights_to_be_trained(tmp_path):
    (tmp_path / "outputs" / "full" / "weights").mkdir(parents=True)
    for weights, kept in (
        ("outputs/full/weights", True),
        ("outputs/big/weights", False),
        ("elsewhere", True),
        ("", True),
    ):
        assert settled({"weights": weights}, tmp_path) == {"weights": weights if kept else ""}
