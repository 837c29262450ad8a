"""The arena as a room would show it: MuJoCo's renderer with textures, lamps and shadows (Section Hardware).

It shares the layout's geometry with the fast camera and nothing else: no colour, no light, no line of drawing code.
"""

from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.arena import solid
from lt_lib.envs.layout import Layout
from lt_lib.envs.materials import GOAL_PILLAR
from lt_lib.envs.opengl import open_renderer
from lt_lib.hardware.placements import CLUTTER, OBJECTS, Placements

TEXELS = 256
TILE = 0.5  # metres that a texture spans
# Materials of the room, RGB: beige vinyl, whitewashed boards, cardboard, red lacquer, the room behind
COLOURS = {"floor": (150, 138, 120), "wall": (214, 210, 200), "barrier": (176, 146, 108), "slab": (196, 30, 38)}
ROOM = ((0.62, 0.64, 0.66), (0.35, 0.33, 0.32))  # upper and lower colour of the background
GOAL, ROBOT = (0.2, 0.5, 0.24), (0.85, 0.68, 0.2)  # painted wood, and yellow plastic
UNDERGROUND = (0.0, 0.0, -5.0)  # where bodies wait that a picture does not show
Light = Literal["bright", "dim", "even"]
LAMPS = {"bright": (1, 1), "dim": (1, 0), "even": (0, 0)}  # the left one and the right one, on or off
WARM = (1.0, 0.86, 0.68)  # colour of the one lamp that is left in the dim state
SHAPES = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class SurrogateScene:
    """Pictures of placements, as wide as a whole frame of the camera; needs OpenGL.

    width, height  pixels of a picture
    focal          pixels: the focal length
    """

    def __init__(self, layout: Layout, width: int, height: int, focal: float):
        self._layout = layout
        fovy = 2 * np.rad2deg(np.arctan(height / 2 / focal))
        self._model = mujoco.MjModel.from_xml_string(scene_xml(layout, width, height, fovy))
        self._data = mujoco.MjData(self._model)
        _paint(self._model)
        model = self._model
        self._lights = model.light_diffuse.copy(), model.light_specular.copy(), model.vis.headlight.ambient.copy()
        self._renderer = open_renderer(self._model, height, width)

    def picture(self, placements: Placements, i: int, clutter: int) -> UInt8[np.ndarray, "h w 3"]:
        """Placement i, RGB, with `clutter` objects on the floor; under two lamps, or under one if it is a dim one."""
        self._place(placements.eye[i], int(placements.slab[i]), placements.slab_offset[i])
        self._scatter(placements.clutter[i][:clutter])
        return self._drawn("dim" if placements.dim[i] else "bright")

    def sight(
        self, eye: Float[np.ndarray, "3"], slab: int, other: Float[np.ndarray, "2"], light: Light
    ) -> UInt8[np.ndarray, "h w 3"]:
        """What a robot sees that drives: the slab exactly in its corridor, the other robot (metres), a bare floor."""
        self._place(eye, slab, np.zeros(3))
        self._scatter(np.empty((0, CLUTTER)))
        self._move("robot", (*other, 0.0), 0.0)
        return self._drawn(light)

    def _drawn(self, light: Light) -> UInt8[np.ndarray, "h w 3"]:
        self._light(light)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, camera="eye")
        return self._renderer.render().copy()

    def close(self):
        self._renderer.close()

    def _place(self, eye: Float[np.ndarray, "3"], slab: int, offset: Float[np.ndarray, "3"]):
        """The camera, and the slab off its corridor by so much (metres, metres, radians); no other robot."""
        x, y, heading = eye
        self._move("eye", (x, y, self._layout.camera.height), heading)
        (x, y), (dx, dy, turn) = self._layout.slab(slab).centre, offset
        self._move("slab", (x + dx, y + dy, self._layout.slab_height / 2), turn)
        self._move("robot", UNDERGROUND, 0.0)

    def _scatter(self, objects: Float[np.ndarray, "k 9"]):
        for k in range(OBJECTS):
            self._move(f"clutter {k}", UNDERGROUND, 0.0)
        for k, (x, y, width, height, yaw, *colour, shape) in enumerate(objects):
            geom = self._model.geom(f"clutter {k}").id
            self._move(f"clutter {k}", (x, y, height / 2), yaw)
            self._model.geom_type[geom] = SHAPES[int(shape)]
            self._model.geom_size[geom] = (width, height / 2, 0) if shape == 1 else (width, width, height / 2)
            self._model.geom_rgba[geom, :3] = colour

    def _move(self, body: str, position, yaw: float):
        mocap = self._model.body(body).mocapid[0]
        self._data.mocap_pos[mocap] = position
        self._data.mocap_quat[mocap] = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))

    def _light(self, light: Light):
        """Both lamps, or the left one alone and warm, or none but light from everywhere."""
        diffuse, specular, ambient = self._lights
        colour, on = np.array(WARM) if light == "dim" else np.ones(3), np.array(LAMPS[light])
        self._model.light_active[:] = on
        self._model.light_diffuse[:] = diffuse * colour * on[:, None]
        self._model.light_specular[:] = specular * colour * on[:, None]
        self._model.vis.headlight.ambient = np.ones(3) if light == "even" else ambient * colour


def scene_xml(layout: Layout, width: int, height: int, fovy: float) -> str:
    """MJCF of the room; bodies that a placement moves are mocap bodies."""
    textures = "".join(
        f'<texture name="{name}" type="2d" builtin="flat" rgb1="1 1 1" width="{TEXELS}" height="{TEXELS}"/>'
        f'<material name="{name}" texture="{name}" texuniform="true" texrepeat="{1 / TILE} {1 / TILE}" '
        f'specular="{0.5 if name == "slab" else 0.1}" shininess="{0.6 if name == "slab" else 0.2}"/>'
        for name in COLOURS
    )
    x0, x1, y0, y1 = layout.slab(0).bounds
    objects = "".join(
        f'<body name="clutter {k}" mocap="true"><geom name="clutter {k}" type="box" size=".1 .1 .1"/></body>'
        for k in range(OBJECTS)
    )
    walls = "".join(solid(wall, f'material="{wall.material}"') for wall in layout.walls)
    lamp = 'type="spot" cutoff="85" exponent="1" castshadow="true" attenuation="1 0 0" specular="0.3 0.3 0.3"'
    return f"""
<mujoco>
  <statistic extent="4" center="{x1} 0 0.5"/>
  <visual>
    <map znear="0.01" zfar="30"/>
    <quality offsamples="0" shadowsize="1024"/>
    <global offwidth="{width}" offheight="{height}"/>
    <headlight ambient="0.35 0.35 0.36" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="{_numbers(ROOM[0])}" rgb2="{_numbers(ROOM[1])}" width="64"
             height="384"/>
    {textures}
  </asset>
  <worldbody>
    <light name="left" {lamp} pos="{x1 + 1.2} 1.6 2.6" dir="-0.35 -0.5 -1" diffuse="0.5 0.5 0.48"/>
    <light name="right" {lamp} pos="{x1 + 2.4} -1.4 2.6" dir="-0.7 0.35 -1" diffuse="0.4 0.4 0.42"/>
    <geom type="plane" size="20 20 1" material="floor"/>
    {walls}
    <body name="slab" mocap="true">
      <geom type="box" size="{(x1 - x0) / 2} {(y1 - y0) / 2} {layout.slab_height / 2}" material="slab"/>
    </body>
    {objects}
    <geom type="cylinder" pos="{layout.goal.x} {layout.goal.y} {GOAL_PILLAR[1] / 2}"
          size="{GOAL_PILLAR[0]} {GOAL_PILLAR[1] / 2}" rgba="{_numbers(GOAL)} 1"/>
    <body name="robot" mocap="true">
      <geom type="cylinder" pos="0 0 {layout.robot.height / 2}" size="{layout.robot.radius} {layout.robot.height / 2}"
            rgba="{_numbers(ROBOT)} 1"/>
    </body>
    <body name="eye" mocap="true"><camera name="eye" fovy="{fovy}" xyaxes="0 -1 0 0 0 1"/></body>
  </worldbody>
</mujoco>"""


def _numbers(values) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def _paint(model: mujoco.MjModel):
    """Writes the materials' patterns into the compiled textures: tiles, boards, corrugation, brushed paint."""
    rng = np.random.default_rng(0)  # one room, whatever is placed in it
    for name, colour in COLOURS.items():
        texture = model.texture(name)
        start = int(texture.adr[0])
        pattern = _pattern(name, rng)[..., None] * np.array(colour)
        model.tex_data[start : start + pattern.size] = np.clip(pattern, 0, 255).astype(np.uint8).ravel()


def _pattern(name: str, rng: np.random.Generator) -> Float[np.ndarray, "texels texels"]:
    """Brightness of a material relative to its colour: blotches of two sizes, and what is typical of it."""
    blotches = [np.kron(rng.normal(0, s, (n, n)), np.ones((TEXELS // n,) * 2)) for n, s in ((16, 0.05), (128, 0.04))]
    u, v = np.meshgrid(np.arange(TEXELS), np.arange(TEXELS))
    typical = {
        "floor": np.where((u % 128 < 3) | (v % 128 < 3), -0.35, 0.0),  # joints
        "wall": np.where(v % 64 < 2, -0.2, 0.0) + 0.04 * np.sin(u / 3 + 4 * np.sin(v / 40)),  # boards and grain
        "barrier": 0.1 * np.sin(2 * np.pi * u / 8),  # corrugation
        "slab": 0.05 * np.sin(2 * np.pi * v / 16),  # brush
    }
    return 1 + sum(blotches) + typical[name]
