"""The same scene drawn by MuJoCo's own renderer: the reference for the fast camera, and the view from above."""

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.layout import OUTER_THICKNESS, Box, Layout
from lt_lib.envs.materials import GOAL_PILLAR, INDEX, MATERIALS
from lt_lib.envs.opengl import open_renderer

FACE = 1e-3  # metres; walls are drawn as thin faces, one colour per direction
SEEN, NAVIGATOR, SCOUT, FROM_ABOVE = 0, 1, 2, 3  # geom groups


class ReferenceCamera:
    """`mujoco.Renderer` behind the call of `FastCamera`: slow and exact. It needs OpenGL."""

    def __init__(self, layout: Layout, pixels: int | None = None):
        self.pixels = pixels or layout.camera.pixels
        self._layout = layout
        self.model = mujoco.MjModel.from_xml_string(scene_xml(layout, self.pixels))
        self._data = mujoco.MjData(self.model)
        self._renderer = open_renderer(self.model, self.pixels, self.pixels)
        self._options = _looking_at(SEEN, SCOUT)
        self._index = palette_indices(self.model)

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w"]:
        """Palette indices from MuJoCo's segmentation; arguments as for `FastCamera.frames`."""
        self._renderer.enable_segmentation_rendering()
        frames = self._each(eyes, slabs, others)
        self._renderer.disable_segmentation_rendering()
        return self._index[frames[..., 0]]  # the geom id; the background is -1, the last entry

    def pictures(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w 3"]:
        """Rendered RGB colours; arguments as for `FastCamera.frames`."""
        return self._each(eyes, slabs, others)

    def _each(self, eyes, slabs, others):
        out = []
        for eye, slab, other in zip(eyes, slabs, others, strict=True):
            place(self._layout, self.model, self._data, eye, int(slab), other)
            self._renderer.update_scene(self._data, camera="eye", scene_option=self._options)
            out.append(self._renderer.render().copy())
        return np.stack(out)

    def close(self):
        self._renderer.close()


class TopView:
    """The arena from straight above, without perspective, as RGB frames for figures and GIFs.

    `extent` holds the picture's (left, right, bottom, top) in metres.
    """

    def __init__(self, layout: Layout, width: int = 480):
        self._width = width
        (x0, x1), (y0, y1) = layout.arena.x, layout.arena.y
        margin = 2 * OUTER_THICKNESS
        height = int(width * (y1 - y0 + margin) / (x1 - x0 + margin)) // 2 * 2
        tall = y1 - y0 + margin
        middle, half = (x0 + x1) / 2, tall * width / height / 2
        self.extent = (middle - half, middle + half, (y0 + y1 - tall) / 2, (y0 + y1 + tall) / 2)
        self._layout = layout
        self.model = mujoco.MjModel.from_xml_string(scene_xml(layout, max(width, height)))
        self._data = mujoco.MjData(self.model)
        self._renderer = open_renderer(self.model, height, width)
        self._options = _looking_at(SEEN, SCOUT, NAVIGATOR, FROM_ABOVE)

    def __reduce__(self):
        return TopView, (self._layout, self._width)  # a copy opens its own OpenGL

    def picture(self, navigator, slab: int, scout) -> UInt8[np.ndarray, "h w 3"]:
        """The scene with navigator (3,) and scout (2,) or (3,), metres and radians, and slab 0 left or 1 right."""
        place(self._layout, self.model, self._data, navigator, slab, scout[:2])
        self._renderer.update_scene(self._data, camera="above", scene_option=self._options)
        return self._renderer.render().copy()


def place(layout: Layout, model, data, eye, slab: int, other):
    """Places the navigator (3,), the slabs (with two corridors 0 left, 1 right), the other robot (2,) in an MjData."""
    height = layout.camera.height
    data.mocap_pos[model.body("navigator").mocapid[0]] = (eye[0], eye[1], height)
    data.mocap_quat[model.body("navigator").mocapid[0]] = (np.cos(eye[2] / 2), 0, 0, np.sin(eye[2] / 2))
    for i, (x0, x1, y0, y1) in enumerate(layout.slabs[slab]):
        data.mocap_pos[model.body(f"slab {i}").mocapid[0]] = ((x0 + x1) / 2, (y0 + y1) / 2, 0)
    data.mocap_pos[model.body("scout").mocapid[0]] = (other[0], other[1], 0)
    mujoco.mj_forward(model, data)


def scene_xml(layout: Layout, pixels: int) -> str:
    """MJCF of everything visible, in flat light, so that a pixel has the colour of its material."""
    (x0, x1), (y0, y1), camera = layout.arena.x, layout.arena.y, layout.camera
    walls = "".join(_faces(i, wall) for i, wall in enumerate(layout.walls))
    above = "".join(_lid(i, wall) for i, wall in enumerate(layout.walls))
    slab = layout.slab(0)
    sx, sy = slab.bounds[1] - slab.bounds[0], slab.bounds[3] - slab.bounds[2]
    centred = Box((-sx / 2, sx / 2, -sy / 2, sy / 2), slab.height, "slab")
    slabs = "".join(
        f'''
    <body name="slab {i}" mocap="true">{_faces(f"slab {i}", centred)}
      <geom name="slab_z:{i}" type="box" pos="0 0 {slab.height - FACE / 2}"
            size="{sx / 2} {sy / 2} {FACE / 2}" {_rgba("slab_z")}/>
    </body>'''
        for i in range(layout.slabs.shape[1])
    )
    return f"""
<mujoco>
  <statistic extent="1" center="0 0 0"/>
  <visual>
    <map znear="0.01" zfar="100"/>
    <quality offsamples="0" shadowsize="0"/>
    <global offwidth="{max(pixels, 64)}" offheight="{max(pixels, 64)}"/>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <asset><texture type="skybox" builtin="flat" rgb1="{_rgb("sky")}" width="8" height="48"/></asset>
  <worldbody>
    <camera name="above" projection="orthographic" pos="{(x0 + x1) / 2} {(y0 + y1) / 2} {2 * layout.wall_height}"
            fovy="{y1 - y0 + 2 * OUTER_THICKNESS}"/>
    <geom name="floor:0" type="plane" size="50 50 1" group="{SEEN}" {_rgba("floor")}/>
    {walls}{above}
    <geom name="goal:0" type="cylinder" pos="{layout.goal.x} {layout.goal.y} {GOAL_PILLAR[1] / 2}"
          size="{GOAL_PILLAR[0]} {GOAL_PILLAR[1] / 2}" {_rgba("goal")}/>
    <geom name="pad" type="cylinder" pos="{layout.goal.x} {layout.goal.y} 0.01" group="{FROM_ABOVE}"
          size="{layout.goal.radius} 0.01" rgba="0.5 0.8 0.5 1"/>
    {slabs}
    <body name="scout" mocap="true">{_robot(layout, "robot:0", SCOUT, "robot")}</body>
    <body name="navigator" mocap="true" pos="0 0 {camera.height}">
      <camera name="eye" fovy="{camera.fov}" xyaxes="0 -1 0 0 0 1"/>
      {_robot(layout, "self", NAVIGATOR, "robot", -camera.height)}
      <geom name="nose" type="box" pos="{layout.robot.radius} 0 0.12" size="0.08 0.04 0.02" group="{NAVIGATOR}"
            rgba="0.1 0.1 0.1 1"/>
    </body>
  </worldbody>
</mujoco>"""


def _rgb(material: str) -> str:
    return " ".join(f"{c / 255:.6f}" for c in MATERIALS[material])


def _rgba(material: str) -> str:
    return f'rgba="{_rgb(material)} 1"'


def _faces(name, box: Box) -> str:
    """MJCF of four thin faces whose outer sides are the sides of the box."""
    (x0, x1, y0, y1), h, out = box.bounds, box.height / 2, ""
    for axis, at, across in (
        ("x", x0 + FACE / 2, 0),
        ("x", x1 - FACE / 2, 1),
        ("y", y0 + FACE / 2, 2),
        ("y", y1 - FACE / 2, 3),
    ):
        along_x = axis == "x"
        pos = (at, (y0 + y1) / 2, h) if along_x else ((x0 + x1) / 2, at, h)
        size = (FACE / 2, (y1 - y0) / 2, h) if along_x else ((x1 - x0) / 2 - FACE, FACE / 2, h)
        out += _box(f"{box.material}_{axis}:{name}.{across}", pos, size, SEEN, _rgba(f"{box.material}_{axis}"))
    return out


def _lid(name, box: Box) -> str:
    """MJCF of a wall's top, shown only from above."""
    x0, x1, y0, y1 = box.bounds
    pos, size = ((x0 + x1) / 2, (y0 + y1) / 2, box.height), ((x1 - x0) / 2, (y1 - y0) / 2, FACE)
    return _box(f"lid:{name}", pos, size, FROM_ABOVE, _rgba(f"{box.material}_x"))


def _box(name, pos, size, group, rgba) -> str:
    numbers = [" ".join(f"{v:.6f}" for v in values) for values in (pos, size)]
    return f'<geom name="{name}" type="box" pos="{numbers[0]}" size="{numbers[1]}" group="{group}" {rgba}/>'


def _robot(layout: Layout, name: str, group: int, material: str, z: float = 0.0) -> str:
    half = layout.robot.height / 2
    return (
        f'<geom name="{name}" type="cylinder" pos="0 0 {half + z}" size="{layout.robot.radius} {half}" '
        f'group="{group}" {_rgba(material)}/>'
    )


def palette_indices(model: mujoco.MjModel) -> UInt8[np.ndarray, " entries"]:
    """The palette index of each geom of a scene; the last entry is the background's."""
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) or "" for i in range(model.ngeom)]
    materials = [name.split(":")[0] for name in names]
    return np.array([INDEX.get(name, INDEX["sky"]) for name in materials] + [INDEX["sky"]], np.uint8)


def _looking_at(*groups: int) -> mujoco.MjvOption:
    options = mujoco.MjvOption()
    options.geomgroup[:] = 0
    options.geomgroup[list(groups)] = 1
    return options
