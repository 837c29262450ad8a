"""The two-robot team as a PettingZoo environment: a navigator that chooses, a scout that sees, a channel between them.

The scout's action is its message, of any content. The channel is the paper's (Section Broadcast and anchor): a message
reaches the navigator `latency` control steps later, one by default, with the anchor at its arrival. Learners may train
either robot or both; a frozen encoder as the scout's policy is the paper's own condition.
"""

from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from jaxtyping import UInt8
from pettingzoo import ParallelEnv

from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.messages import CONTENT
from lt_lib.environments.gym import Scenes, finite, frame_space, velocity_space
from lt_lib.envs.arena import CONTROL_HZ
from lt_lib.envs.layout import load_layout
from lt_lib.envs.reference import TopView
from lt_lib.settings.base import LATENCY, UserError

NAVIGATOR, SCOUT = "navigator", "scout"


class TeamEnv(ParallelEnv):
    """Both robots get the team's reward and end together: on the navigator's arrival or after 600 steps.

    navigator  observes {"frame": own frame (64, 64, 3) uint8, "wire": (2 + content,) float32, zeros before the first
               message arrives}; acts with a body-frame velocity in [-1, 1]^3
    scout      observes its own frame (64, 64, 3) uint8; acts with a message (content,) float32; stands still

    Raises UserError for an unknown layout, for a latency below 1, and for `render_mode="rgb_array"` without OpenGL.
    """

    metadata: ClassVar = {"name": "latent_telepathy_v0", "render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}

    def __init__(
        self, layout: str = "default", content: int = CONTENT, latency: int = LATENCY, render_mode: str | None = None
    ):
        if latency < 1:
            raise UserError(f"latency: expected 1 or more control steps, since a message is an action, got {latency}")
        self._scenes, self._rng = Scenes(load_layout(layout), 1), np.random.default_rng()
        scene = self._scenes.arena.layout
        self.possible_agents, self.agents = [NAVIGATOR, SCOUT], []
        wire = Box(-np.inf, np.inf, (ANCHOR + content,), np.float32)
        self.observation_spaces = {
            NAVIGATOR: Dict({"frame": frame_space(scene), "wire": wire}),
            SCOUT: frame_space(scene),
        }
        self.action_spaces = {NAVIGATOR: velocity_space(), SCOUT: Box(-np.inf, np.inf, (content,), np.float32)}
        self._wire, self._age = np.zeros(wire.shape, np.float32), 0
        self._in_flight = Channel((1,), content, scene.communication_radius, latency)
        self.render_mode = render_mode
        self._view = TopView(scene) if render_mode else None

    def observation_space(self, agent: str):
        return self.observation_spaces[agent]

    def action_space(self, agent: str):
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts a new episode; `seed` seeds this and all later ones. There are no options."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self._scenes.restart(np.ones(1, bool), [self._rng])
        self.agents = list(self.possible_agents)
        self._wire, self._age = np.zeros_like(self._wire), 0
        self._in_flight.forget()
        return self._observe(), self._each(self._scenes.info())

    def step(self, actions: dict[str, np.ndarray]):
        if not self.agents:
            return {}, {}, {}, {}, {}
        self._require(actions)
        message = finite("message", actions[SCOUT], self.action_spaces[SCOUT].shape)
        command = finite("action", actions[NAVIGATOR], self.action_spaces[NAVIGATOR].shape)
        arena = self._scenes.arena
        self._in_flight.send(self._age, torch.from_numpy(message).float()[None], arena.scout[:, :2])
        reward, terminated, truncated = self._scenes.step(command[None])
        self._age += 1
        self._wire = self._in_flight.receive(self._age, arena.pose[:, :2])[0].numpy()
        told = self._observe(), *map(self._each, (reward.item(), terminated.item(), truncated.item()))
        infos = self._each(self._scenes.info())
        if terminated or truncated:
            self.agents = []
        return *told, infos

    def _require(self, actions: dict[str, Any]) -> None:
        """Raises UserError unless there is an action for every agent and no other."""
        if set(actions) != set(self.agents):
            given = ", ".join(map(str, actions)) or "none"
            raise UserError(f"actions: expected one for each of {', '.join(self.agents)}, got {given}")

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:
        return self._scenes.seen_by(self._view) if self._view else None

    def _observe(self) -> dict[str, Any]:
        navigator = {"frame": self._scenes.navigator_frames()[0], "wire": self._wire}
        return {NAVIGATOR: navigator, SCOUT: self._scenes.scout_frames()[0]}

    def _each(self, value: Any) -> dict[str, Any]:
        return dict.fromkeys(self.possible_agents, value)
