"""A scout that moves: its paths, the stream of its messages through the channel, and the receiver that pools them."""

import numpy as np
import pytest
import torch

from lt_lib.beyond.motion import STEP, TURN, errands, patrols, room, towards, turned
from lt_lib.beyond.moving import EGO, WIRE, StreamHead, draw_drives, stream, train_moving
from lt_lib.comm.channel import ANCHOR, anchor
from lt_lib.envs.layout import load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.jepa import train_encoder
from lt_lib.settings.beyond import MovingConfig
from lt_lib.settings.perception import EncoderConfig

LAYOUT = load_layout("default")


def quiet(_: float) -> None:
    pass


@pytest.fixture(scope="module")
def weights():
    return train_encoder(EncoderConfig(frames=640, epochs=0.0), 0, report=quiet)


def observed(config: MovingConfig, weights, seed: int = 0):
    """Drives, and what a head observes of them, split into place, wires (n, m, w) and presence (n, m)."""
    rng = np.random.default_rng(seed)
    drives = draw_drives(LAYOUT, config, rng)
    flat, seeing = stream(LAYOUT, FrozenEncoder(weights), config, drives, rng)
    messages = (flat.shape[1] - EGO) // (WIRE + 1)
    place, wires, present = flat.split([EGO, messages * WIRE, messages], dim=1)
    return drives, place, wires.unflatten(1, (messages, WIRE)), present, seeing


# --- paths
def test_a_patrol_keeps_to_the_room_at_the_robots_speed_and_knows_no_slab():
    poses = patrols(LAYOUT, 50, 200, 1.0, np.random.default_rng(0))
    low, high = room(LAYOUT)
    assert (poses[..., :2] >= low).all() and (poses[..., :2] <= high).all()
    assert np.hypot(*np.diff(poses[..., :2], axis=1).transpose(2, 0, 1)).max() <= STEP + 1e-9
    turns = (np.diff(poses[..., 2], axis=1) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turns).max() <= TURN + 1e-9
    config = MovingConfig(content="floor", scenes=400)
    drives = draw_drives(LAYOUT, config, np.random.default_rng(1))
    sides = [drives.poses[drives.slab == slab, 0, :, :2].mean(0) for slab in (0, 1)]
    assert np.abs(sides[0] - sides[1]).max() < 0.5  # the same places under either placement


def test_an_errand_drives_through_the_free_corridor_to_the_goal():
    free = np.arange(20) % 2
    poses = errands(LAYOUT, free, 260, np.random.default_rng(0))
    corridor = LAYOUT.corridor_at(poses[..., 0], poses[..., 1])
    for side, there in zip(free, corridor, strict=True):
        assert set(there) == {-1, side}
    assert LAYOUT.free(poses[..., 0], poses[..., 1], LAYOUT.robot.radius).all()
    assert np.hypot(poses[:, -1, 0] - LAYOUT.goal.x, poses[:, -1, 1] - LAYOUT.goal.y).max() < LAYOUT.goal.radius


def test_driving_and_turning_take_the_shorter_way_and_stop():
    here, arrived = towards(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[3.0, 4.0], [1.0, 0.01]]))
    np.testing.assert_allclose(here, [[0.6 * STEP, 0.8 * STEP], [1.0, 0.01]])
    assert arrived.tolist() == [False, True]
    np.testing.assert_allclose(turned(np.array([3.0, 0.0]), np.array([-3.0, 0.05])), [3.0 + TURN, 0.05])


# --- the stream
@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_message_never_arrives_early_and_its_anchor_is_that_of_its_sending(latency, weights):
    config = MovingConfig(content="position", scenes=16, commit_step=12, every=4, latency=latency)
    drives, _, wires, present, _ = observed(config, weights)
    sent = [step for step in range(0, 13, 4) if step + latency <= 12]
    assert wires.shape[1] == len(sent) and present.all()
    for i, step in enumerate(sent):
        where = anchor(drives.poses[:, 0, step, :2], drives.navigator, LAYOUT.communication_radius)
        torch.testing.assert_close(wires[:, i, :ANCHOR], where)
        said = torch.from_numpy(drives.poses[:, 0, step, :2] / LAYOUT.communication_radius).float()
        torch.testing.assert_close(wires[:, i, ANCHOR : ANCHOR + 2], said)


def test_the_anchor_can_be_withheld_and_contents_stand_side_by_side(weights):
    bare = observed(MovingConfig(content="latent", wire="anchor_zeroed", scenes=16), weights)[2]
    assert not bare[..., :ANCHOR].any() and bare[..., ANCHOR:].any()
    both = observed(MovingConfig(content="latent and trajectory", scenes=16), weights)[2]
    latent = observed(MovingConfig(content="latent", scenes=16), weights)[2]
    trajectory = observed(MovingConfig(content="trajectory", scenes=16), weights)[2]
    torch.testing.assert_close(both[..., : ANCHOR + 64], latent[..., : ANCHOR + 64])
    torch.testing.assert_close(both[..., ANCHOR + 64 :], trajectory[..., ANCHOR : ANCHOR + 64])
    assert not latent[..., ANCHOR + 64 :].any()


def test_who_watches_the_barrier_sees_the_slab_more_often(weights):
    shares = [observed(MovingConfig(content="floor", scenes=100, watching=w), weights)[4].mean() for w in (0.0, 1.0)]
    assert shares[0] < 0.4 and shares[1] >= 0.5


# --- the receiver
def test_the_receiver_minds_neither_order_nor_absent_nor_more_messages_than_there_are():
    torch.manual_seed(0)
    place, wires = torch.rand(5, EGO), torch.rand(5, 4, WIRE)
    head = StreamHead(4)
    torch.nn.init.normal_(head.receiver.value.weight)
    torch.nn.init.normal_(head.head.logits.weight)

    def logits(network, wires, present):
        return network.policy(torch.cat([place, wires.flatten(1), present], dim=1)).logits

    everyone = torch.ones(5, 4)
    order = [2, 0, 3, 1]
    torch.testing.assert_close(logits(head, wires, everyone), logits(head, wires[:, order], everyone))
    two = torch.tensor([[1.0, 0.0, 1.0, 0.0]]).expand(5, 4)
    fewer = StreamHead(2)
    fewer.load_state_dict(head.state_dict())
    torch.testing.assert_close(logits(head, wires, two), logits(fewer, wires[:, ::2], torch.ones(5, 2)))
    twice = torch.cat([wires[:, :2], wires[:, :2]], dim=1)  # each message heard twice weighs what it weighed
    torch.testing.assert_close(logits(head, twice, everyone), logits(fewer, wires[:, :2], torch.ones(5, 2)))
    nobody = torch.zeros(5, 4)
    torch.testing.assert_close(logits(head, wires, nobody), logits(head, torch.rand(5, 4, WIRE), nobody))


def test_kinematics_tell_nothing_on_patrol_and_everything_on_errands(weights):
    def share(content, **changes):
        config = MovingConfig(content=content, scenes=1_024, episodes=4_000, heads=1, held_out=0.5, **changes)
        return train_moving(config, 0, report=quiet, encoder=weights)["greedy"].mean()

    assert abs(share("trajectory") - 0.5) < 0.08 and abs(share("floor") - 0.5) < 0.08
    assert share("trajectory", errands=1.0) > 0.95
    assert share("oracle") > 0.95  # the stream is read where it tells


def test_several_scouts_send_several_streams(weights):
    drives, _, wires, _, seeing = observed(MovingConfig(content="position", scenes=16, scouts=3), weights)
    assert drives.poses.shape[1] == 3 and wires.shape[1] == 3 * 10 and seeing.shape == (16,)
