"""The walled arena (Section Setup), many navigators stepped together by MuJoCo's equations.

MuJoCo reads the scene and `planar` takes its steps. Physics runs at 60 Hz and control at 10 Hz. An action is a
body-frame velocity (vx, vy, omega) in [-1, 1]^3, scaled to 0.5 m/s and 1.5 rad/s. The slab is solid, so a step in
contact with it is a wasted step, not a shortcut.
"""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from lt_lib.envs import planar
from lt_lib.envs.layout import Box, Layout

PHYSICS_HZ = 60
CONTROL_HZ = 10
V_MAX = 0.5  # m/s
W_MAX = 1.5  # rad/s
HORIZON = 600  # control steps
CONTACT = 0.005  # metres; anything nearer counts as touching

MASS, GAIN, FORCE = (
    1.0,
    100.0,
    20.0,
)  # kg, N s/m, N: reaches full speed within three physics steps, cannot push through a wall


class Arena:
    """n independent scenes, each with one navigator. The attributes describe the state after the latest step:

    pose      (n, 3) x, y, heading of the navigators: metres, metres, radians
    slab      (n,) placement of the slabs; with two corridors, the blocked one, 0 left, 1 right
    scout     (n, 3) the scouts' poses
    contact   (n,) whether the navigator touches the slab
    reached   (n,) whether the navigator is at the goal
    corridor  (n,) the corridor that the navigator stands in: 0 left, 1 right, NO_CORRIDOR none
    """

    def __init__(self, layout: Layout, n: int):
        self.layout = layout
        model = mujoco.MjModel.from_xml_string(physics_xml(layout))
        self.timestep = model.opt.timestep  # seconds of simulated time per physics step
        self._mechanics = planar.mechanics(model)
        self._boxes = planar.boxes(model, layout.slab_centres)
        self._qpos, self._qvel, self._time = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
        self.slab = np.zeros(n, np.int64)
        self.scout = np.tile(layout.scout.array, (n, 1))

    @property
    def n(self) -> int:
        return len(self._qpos)

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Seconds of simulated time."""
        return self._time.copy()

    @property
    def pose(self) -> Float[np.ndarray, "n 3"]:
        return self._qpos.copy()

    def reset(
        self,
        which: Bool[np.ndarray, " n"],
        pose: Float[np.ndarray, "n 3"],
        slab: Int[np.ndarray, " n"],
        scout: Float[np.ndarray, "n 3"],
    ):
        """Starts new episodes in the scenes of `which`, with the slabs placed as `slab` says."""
        self._qpos[which], self._qvel[which] = pose[which], 0.0
        self.slab[which], self.scout[which] = slab[which], scout[which]
        self._observe()

    def step(self, action: Float[np.ndarray, "n 3"], live: Bool[np.ndarray, " n"] | None = None):
        """Takes one control step of 0.1 s; actions are clipped to [-1, 1]. Scenes that are not `live` stand still."""
        planar.advance(
            self._qpos,
            self._qvel,
            self._time,
            self.command(action),
            np.ones(self.n, bool) if live is None else live,
            self.slab,
            self.scout,
            self._boxes,
            self._mechanics,
            PHYSICS_HZ // CONTROL_HZ,
        )
        self._observe()

    def command(self, action: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The world-frame velocities that an action asks for: m/s, m/s, rad/s."""
        vx, vy, turn = np.clip(action, -1.0, 1.0).T
        cos, sin = np.cos(self._qpos[:, 2]), np.sin(self._qpos[:, 2])
        return np.column_stack([V_MAX * (cos * vx - sin * vy), V_MAX * (sin * vx + cos * vy), W_MAX * turn])

    def state(self) -> dict[str, np.ndarray]:
        """Every number that the next step depends on, to be given to `restore`, also in another process."""
        parts = {"qpos": self._qpos, "qvel": self._qvel, "slab": self.slab, "scout": self.scout}
        return {name: values.copy() for name, values in parts.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes on from a `state` of an arena of the same layout and size.

        Raises ValueError for a state of another shape or one that is not finite.
        """
        for name, values in self.state().items():
            if state[name].shape != values.shape or not np.isfinite(state[name]).all():
                raise ValueError(f"state: {name} must be finite, of shape {values.shape}, got {state[name].shape}")
        self._qpos[:], self._qvel[:] = state["qpos"], state["qvel"]
        self.slab[:], self.scout[:] = state["slab"], state["scout"]
        self._observe()

    def _observe(self):
        x, y = self._qpos[:, 0], self._qpos[:, 1]
        self.contact = self.layout.slab_distance(self.slab, x, y) < self.layout.robot.radius + CONTACT
        self.reached = np.hypot(x - self.layout.goal.x, y - self.layout.goal.y) < self.layout.goal.radius
        self.corridor = self.layout.corridor_at(x, y)


def physics_xml(layout: Layout) -> str:
    """MJCF of everything that can be hit: planar, without a floor, each robot's disc as a sphere."""
    walls = "".join(solid(wall) for wall in layout.walls)
    slab = layout.slab(0)
    (cx, cy), (x0, x1, y0, y1) = slab.centre, slab.bounds
    centred = solid(Box((x0 - cx, x1 - cx, y0 - cy, y1 - cy), layout.wall_height, "slab"))
    slabs = "".join(f'<body name="slab {i}" mocap="true">{centred}</body>' for i in range(layout.slabs.shape[1]))
    radius, friction = layout.robot.radius, layout.robot.friction
    # sliding friction along the contact plane; torsion and rolling would brake a sphere that stands for a disc
    return f"""
<mujoco>
  <option timestep="{1 / PHYSICS_HZ}" integrator="implicitfast" gravity="0 0 0"/>
  <default><geom condim="3" friction="{friction} 0 0" contype="1" conaffinity="2"/></default>
  <worldbody>
    {walls}
    {slabs}
    <body name="scout" mocap="true" pos="0 0 {radius}"><geom type="sphere" size="{radius}"/></body>
    <body name="navigator" pos="0 0 {radius}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="heading" type="hinge" axis="0 0 1"/>
      <geom type="sphere" size="{radius}" mass="{MASS}" contype="2" conaffinity="1"/>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="x" kv="{GAIN}" forcerange="-{FORCE} {FORCE}"/>
    <velocity joint="y" kv="{GAIN}" forcerange="-{FORCE} {FORCE}"/>
    <velocity joint="heading" kv="{GAIN / 100}"/>
  </actuator>
</mujoco>"""


def solid(box: Box, attributes: str = "") -> str:
    """MJCF of a box; `attributes` are added to its geom."""
    x0, x1, y0, y1 = box.bounds
    centre = " ".join(f"{value:.6f}" for value in (*box.centre, box.height / 2))
    size = f"{(x1 - x0) / 2:.6f} {(y1 - y0) / 2:.6f} {box.height / 2:.6f}"
    return f'<geom type="box" pos="{centre}" size="{size}" {attributes}/>'
