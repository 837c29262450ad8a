"""The navigator's side of the task for other people's learners: Gymnasium environments around the arena.

    env = gymnasium.make("lt_lib.environments.gym:LatentTelepathy/Corridors-v0")

An observation is the navigator's own frame (64, 64, 3) uint8, an action a body-frame velocity in [-1, 1]^3. The reward
is the team's: +1 for arriving, -0.01 per control step in contact with the slab. Nothing tells which corridor is
blocked, so this is the silent task; `lt_lib.environments.team` adds the teammate who sees it and the channel between
the two.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, UInt8

from lt_lib.envs.arena import CONTROL_HZ, HORIZON, Arena
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import NO_CORRIDOR, SIDES, Layout, load_layout
from lt_lib.envs.reference import TopView
from lt_lib.settings.base import UserError

ARRIVAL_REWARD = 1.0
CONTACT_REWARD = -0.01  # per control step in contact with the slab


def frame_space(layout: Layout) -> Box:
    """A robot's camera frame, RGB."""
    return Box(0, 255, (layout.camera.pixels, layout.camera.pixels, 3), np.uint8)


def velocity_space() -> Box:
    """(vx, vy, omega) in the body's frame; 1 is 0.5 m/s and 1.5 rad/s."""
    return Box(-1, 1, (3,), np.float32)


def finite(what: str, values: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Values as floats. Raises UserError unless they are finite and of the shape; of two axes, the first is rows."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{what}: expected numbers of shape {shape}, got {type(values).__name__}") from None
    if array.shape != shape:
        raise UserError(f"{what}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        if len(shape) > 1:
            row = int(np.argmin(np.isfinite(array).all(axis=1)))
            what, array = f"{what} of environment {row}", array[row]
        raise UserError(f"{what}: expected finite numbers, got {array.tolist()}")
    return array


class Scenes:
    """n episodes side by side; a row depends only on its own generator and actions.

    `entered` (n,) is the first corridor entered in the episode: 0 left, 1 right, -1 none yet.
    """

    def __init__(self, layout: Layout, n: int):
        self.arena, self._camera = Arena(layout, n), FastCamera(layout)
        self.entered, self._age = np.full(n, NO_CORRIDOR), np.zeros(n, np.int64)

    def restart(self, which: Bool[np.ndarray, " n"], rngs: Sequence[np.random.Generator]):
        """New episodes in the rows of `which`; each row's generator draws spawn, scout and slab, in this order."""
        layout = self.arena.layout
        pose, slab, scout = self.arena.pose, self.arena.slab.copy(), self.arena.scout.copy()
        for i in np.flatnonzero(which):
            pose[i], scout[i] = layout.spawn.sample(1, rngs[i])[0], layout.scout.sample(1, rngs[i])[0]
            slab[i] = rngs[i].integers(len(SIDES))
        self.arena.reset(which, pose, slab, scout)
        self.entered[which], self._age[which] = NO_CORRIDOR, 0

    def step(self, action: np.ndarray):
        """One control step; action (n, 3). Returns reward, terminated (arrived) and truncated (time-out), each (n,)."""
        self.arena.step(action)
        self._age += 1
        self.entered = np.where(self.entered == NO_CORRIDOR, self.arena.corridor, self.entered)
        reached = self.arena.reached
        reward = ARRIVAL_REWARD * reached + CONTACT_REWARD * self.arena.contact
        return reward, reached, ~reached & (self._age >= HORIZON)

    def __getstate__(self) -> dict[str, Any]:
        """What copies and other processes need: the scene and every number that the next step depends on."""
        kept = {"entered": self.entered, "age": self._age, "arena": self.arena.state()}
        return kept | {"layout": self.arena.layout.model_dump(mode="json")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(Layout(**state["layout"]), len(state["age"]))
        self.entered, self._age = state["entered"].copy(), state["age"].copy()
        self.arena.restore(state["arena"])

    def navigator_frames(self) -> UInt8[np.ndarray, "n h w 3"]:
        return colours(self._camera.frames(self.arena.pose, self.arena.slab, self.arena.scout[:, :2]))

    def scout_frames(self) -> UInt8[np.ndarray, "n h w 3"]:
        return colours(self._camera.frames(self.arena.scout, self.arena.slab, self.arena.pose[:, :2]))

    def infos(self) -> dict[str, np.ndarray]:
        """For scoring, not for learning: the blocked corridor, the first one entered, contact with the slab; (n,)."""
        return {"slab": self.arena.slab.copy(), "entered": self.entered.copy(), "contact": self.arena.contact}

    def info(self) -> dict[str, Any]:
        """`infos` of the only row."""
        return {name: values.item() for name, values in self.infos().items()}

    def seen_by(self, view: TopView) -> UInt8[np.ndarray, "h w 3"]:
        """The only row, seen from above."""
        return view.picture(self.arena.pose[0], int(self.arena.slab[0]), self.arena.scout[0])


class ArenaEnv(gymnasium.Env):
    """One navigator without messages. Ends on arrival; truncated after 600 steps.

    Raises UserError for an unknown layout, and for `render_mode="rgb_array"` without OpenGL.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}

    def __init__(self, layout: str = "default", render_mode: str | None = None):
        self._scenes = Scenes(load_layout(layout), 1)
        self.observation_space, self.action_space = frame_space(self._scenes.arena.layout), velocity_space()
        self.render_mode = render_mode
        self._view = TopView(self._scenes.arena.layout) if render_mode else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts a new episode; `seed` seeds this and all later ones. There are no options."""
        super().reset(seed=seed)
        self._scenes.restart(np.ones(1, bool), [self.np_random])
        return self._scenes.navigator_frames()[0], self._scenes.info()

    def step(self, action: Any):
        """One control step under an action (3,). Raises UserError for another shape and for one that is not finite."""
        reward, terminated, truncated = self._scenes.step(finite("action", action, self.action_space.shape)[None])
        frame = self._scenes.navigator_frames()[0]
        return frame, reward.item(), terminated.item(), truncated.item(), self._scenes.info()

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:
        return self._scenes.seen_by(self._view) if self._view else None


class ArenaVectorEnv(VectorEnv):
    """n navigators in one batched arena; row i is `ArenaEnv` with seed + i.

    A row that ended restarts in the next step, which ignores its action and has reward 0.
    """

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": [], "render_fps": CONTROL_HZ}

    def __init__(self, num_envs: int = 1, layout: str = "default"):
        self.num_envs, self._scenes = num_envs, Scenes(load_layout(layout), num_envs)
        self.single_observation_space = frame_space(self._scenes.arena.layout)
        self.single_action_space = velocity_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts new episodes everywhere; `seed` seeds every row. There are no options."""
        if seed is not None:
            self._rngs = [np.random.default_rng(seed + i) for i in range(self.num_envs)]
        self._ended[:] = False
        self._scenes.restart(np.ones(self.num_envs, bool), self._rngs)
        return self._scenes.navigator_frames(), self._infos()

    def step(self, actions: Any):
        """One control step under actions (n, 3). Raises UserError for another shape and for one that is not finite."""
        fresh = self._ended
        reward, terminated, truncated = self._scenes.step(finite("action", actions, self.action_space.shape))
        if fresh.any():
            self._scenes.restart(fresh, self._rngs)
            reward, terminated, truncated = reward * ~fresh, terminated & ~fresh, truncated & ~fresh
        self._ended = terminated | truncated
        return self._scenes.navigator_frames(), reward, terminated, truncated, self._infos()

    def _infos(self) -> dict[str, np.ndarray]:
        """`infos` in Gymnasium's form: beside every entry, a mask of the rows that have it."""
        infos = self._scenes.infos()
        return infos | {f"_{name}": np.ones(self.num_envs, bool) for name in infos}


gymnasium.register(
    "LatentTelepathy/Corridors-v0",
    entry_point=f"{__name__}:{ArenaEnv.__name__}",
    vector_entry_point=f"{__name__}:{ArenaVectorEnv.__name__}",
)
