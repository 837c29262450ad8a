"""The same scene drawn by MuJoCo Warp's batch renderer, against which the fast camera's speed is compared.

MuJoCo Warp is written for NVIDIA GPUs and also runs on a CPU.
"""

import warp as wp

wp.config.log_level = wp.LOG_ERROR  # before MuJoCo Warp starts Warp, which would list all devices and kernels

import mujoco
import mujoco_warp as mjw
import numpy as np
from jaxtyping import Float, Int, UInt8

from lt_lib.envs.layout import Layout
from lt_lib.envs.reference import SCOUT, SEEN, palette_indices, scene_xml


class WarpCamera:
    """MuJoCo Warp behind the call of `FastCamera`; it compiles its kernels on first use.

    worlds  scenes drawn at a time
    device  'cpu' or a CUDA device, as Warp names them
    """

    def __init__(self, layout: Layout, worlds: int, device: str = "cpu"):
        self._layout, pixels = layout, layout.camera.pixels
        model = mujoco.MjModel.from_xml_string(scene_xml(layout, pixels))
        self._index, self._device = palette_indices(model), device
        slabs = [f"slab {i}" for i in range(layout.slabs.shape[1])]
        self._mocap = {name: model.body(name).mocapid[0] for name in ("navigator", *slabs, "scout")}
        with wp.ScopedDevice(device):
            self._model = mjw.put_model(model)
            self._data = mjw.put_data(model, mujoco.MjData(model), nworld=worlds)
            self._context = mjw.create_render_context(
                model,
                nworld=worlds,
                cam_res=(pixels, pixels),
                render_rgb=False,
                render_depth=False,
                render_seg=True,
                enabled_geom_groups=[SEEN, SCOUT],
                cam_active=["eye"],
            )
            self._seen = wp.zeros((worlds, pixels, pixels), dtype=wp.vec2i)

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs: Int[np.ndarray, " b"], others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w"]:
        """Palette indices from Warp's segmentation; arguments as for `FastCamera.frames`, one scene per world."""
        position, turn = (
            self._data.mocap_pos.numpy(),
            self._data.mocap_quat.numpy(),
        )  # (B, bodies, 3) and (B, bodies, 4)
        position[:, self._mocap["navigator"]] = np.column_stack(
            [eyes[:, :2], np.full(len(eyes), self._layout.camera.height)]
        )
        turn[:, self._mocap["navigator"]] = 0
        turn[:, self._mocap["navigator"], 0] = np.cos(eyes[:, 2] / 2)
        turn[:, self._mocap["navigator"], 3] = np.sin(eyes[:, 2] / 2)
        for i, centre in enumerate(np.moveaxis(self._layout.slab_centres[slabs], 1, 0)):
            position[:, self._mocap[f"slab {i}"], :2] = centre
        position[:, self._mocap["scout"], :2] = others
        with wp.ScopedDevice(self._device):
            self._data.mocap_pos.assign(position)
            self._data.mocap_quat.assign(turn)
            mjw.kinematics(self._model, self._data)
            mjw.camlight(self._model, self._data)
            mjw.refit_bvh(self._model, self._data, self._context)
            mjw.render(self._model, self._data, self._context)
            mjw.get_segmentation(self._context, 0, self._seen)
            return self._index[self._seen.numpy()[..., 0]]  # the geom id; the background is -1, the last entry
