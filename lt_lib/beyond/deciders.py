"""Heads that learn a task of their own from a broadcast that many receive."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lt_lib import ppo
from lt_lib.beyond.rich import RichScenes, draw_rich_scenes, rich_layout
from lt_lib.beyond.senders import frozen
from lt_lib.beyond.tasks import ANSWERS, TASKS
from lt_lib.beyond.tasks.depth import classes
from lt_lib.beyond.tasks.task import binary
from lt_lib.comm.channel import anchor
from lt_lib.comm.messages import CONTENT
from lt_lib.comm.route_head import Chooser, RouteHead
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.pixels.route import drawn
from lt_lib.settings.beyond import DeciderConfig, DeciderSizes
from lt_lib.settings.profiles import validated
from lt_lib.settings.streams import Stream
from lt_lib.store.run import Result, Run

Content = Callable[[RichScenes, PictureEncoder], np.ndarray]

MESSAGES: dict[str, Content] = (
    {"nothing": lambda scenes, _: np.empty((len(scenes.slab), 0))}
    | {f"'{task.words}' by hand": lambda scenes, _, task=task: task.bits(scenes) for task in TASKS.values()}
    | {"all by hand": lambda scenes, _: np.concatenate([task.bits(scenes) for task in ANSWERS], axis=1)}
    | {f"depth in {k} bits": lambda scenes, _, k=k: binary(classes(scenes, 2**k), k) for k in (2, 3, 4)}
    | {name: lambda scenes, sender: sender.latents(scenes.pictures) for name in ("latent", "untrained")}
)


def train_deciders(
    config: DeciderConfig, seed: int, *, report: Callable[[float], None], sender: Mapping[str, np.ndarray]
) -> dict:
    """Heads of `config.heads` seeds that learn one task from one message.

    "reward"  (heads, scenes) of greedy choices in held-out scenes
    "best", "chance"  (scenes,) the best action's reward there, and the mean over actions
    "course"  (heads, episodes) reward of sampled choices, in order;  "floats" of the message
    """
    layout, task = rich_layout(config.layout), TASKS[config.task]
    scenes = draw_rich_scenes(layout, config.scenes, Stream.LADDER.generator(seed, "rich"))
    content = MESSAGES[config.message](scenes, PictureEncoder(sender, config.device))
    places = scenes.scout[:, :2], np.tile(layout.spawn.array[:2], (config.scenes, 1))
    wires = wired(anchor(*places, layout.communication_radius), content, task.own(scenes))
    rewards, cut = task.reward(scenes), int(config.scenes * config.held_out)
    found, courses = [], []
    for head in range(config.heads):
        rng = Stream.READER.generator(head, config.task, config.message)
        network, course = learned(
            config, partial(RouteHead, wires.shape[1], rewards.shape[1]), wires[cut:], rewards[cut:], rng
        )
        found.append(rewards[np.arange(cut), network.greedy(wires[:cut])])
        courses.append(course)
        report((head + 1) / config.heads)
    tested = rewards[:cut]
    return {
        "reward": np.stack(found),
        "best": tested.max(axis=1),
        "chance": tested.mean(axis=1),
        "course": np.stack(courses).astype(np.float32),
        "floats": content.shape[1],
    }


def wired(
    where: Float[Tensor, "n 2"], content: Float[np.ndarray, "n c"], own: Float[np.ndarray, "n j"]
) -> Float[Tensor, "n w"]:
    """What a receiver reads: the anchor, the content padded to the width of all messages, and what it knows itself."""
    padded = np.pad(content, ((0, 0), (0, CONTENT - content.shape[1])))
    return torch.cat([where, torch.from_numpy(np.concatenate([padded, own], axis=1)).float()], dim=1)


def learned(
    config: DeciderSizes,
    network: Callable[[], Chooser],
    wires: Float[Tensor, "n w"],
    rewards: Float[np.ndarray, "n a"],
    rng: np.random.Generator,
) -> tuple[Chooser, Float[np.ndarray, " episodes"]]:
    """A head trained by the reward of its sampled actions alone, and that reward, episode by episode."""
    head = ppo.built(network, rng)
    optimiser = torch.optim.Adam(head.parameters(), lr=config.lr, eps=1e-5, fused=True)
    course = []
    for start in range(0, config.episodes, config.batch):
        pick = rng.integers(0, len(wires), min(config.batch, config.episodes - start))
        wire = wires[pick]
        with torch.no_grad():
            policy, value = head.outlook(wire)
            action = torch.from_numpy(drawn(policy.probs.numpy(), rng))
        reward = torch.from_numpy(rewards[pick, action.numpy()]).float()
        batch = ppo.Batch(wire, action, policy.log_prob(action), reward - value, reward)
        ppo.update(head, optimiser, batch, config.ppo, config.minibatch, rng)
        course.append(reward.numpy())
    return head, np.concatenate(course)


@dataclass(frozen=True)
class DeciderProtocol:
    """The heads of all tasks, behind one frozen encoder."""

    sizes: DeciderSizes
    pixels: PixelProtocol

    @classmethod
    def of(cls, decider: Mapping[str, Any], pixels: PixelProtocol) -> "DeciderProtocol":
        """From a notebook's parameter. Raises UserError for an unusable one."""
        return cls(validated(DeciderSizes, "decider", dict(decider)), pixels)

    def decided(self, tasks: Collection[str], messages: Collection[str]) -> dict[tuple[str, str], Result]:
        """What heads of every task make of every message; see `train_deciders`."""
        store, sizes = self.pixels.store, self.pixels.sizes
        untrained = sizes.encoder.model_copy(update={"epochs": 0.0})
        (blank,) = store.fetch([Run(train_encoder, untrained, SEED)], "untrained encoder")
        ours = self.pixels.encoder_weights()
        shared = self.sizes.model_dump() | {"layout": self.pixels.layout, "device": sizes.encoder.device}
        runs = {
            (task, message): Run(
                train_deciders,
                DeciderConfig(task=task, message=message, **shared),
                SEED,
                {"sender": frozen(blank if message == "untrained" else ours)},
            )
            for task in tasks
            for message in messages
        }
        return dict(zip(runs, store.fetch(list(runs.values()), "receivers"), strict=True))
