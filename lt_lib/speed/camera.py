"""How much faster the fast camera is than MuJoCo's renderers (Section Setup)."""

import numpy as np
from jaxtyping import Float

from lt_lib.envs.camera import FastCamera, network_input
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.envs.warp_camera import WarpCamera
from lt_lib.speed.turns import taking_turns

BATCH = 256  # frames per turn, as many as training requests at once
WORLDS = 64  # likewise for MuJoCo Warp, whose camera draws as many scenes at a time
FEW = 32  # likewise for the slow renderer


def frame_rates(
    fast: FastCamera,
    reference: ReferenceCamera,
    warp: WarpCamera,
    eyes: Float[np.ndarray, "b 3"],
    slabs,
    others: Float[np.ndarray, "b 2"],
    rounds: int = 5,
) -> dict[str, float]:
    """Frames per second of processor time: the median over rounds in which the cameras take turns.

    Processor time includes all threads of this process, so these are rates of one core. A renderer on a GPU would hide
    its work from this clock.

    warp  draws WORLDS scenes at a time; other arguments as for `FastCamera.frames`
    """
    scenes, several, few = (
        [values[np.arange(count) % len(eyes)] for values in (eyes, np.asarray(slabs), others)]
        for count in (BATCH, WORLDS, FEW)
    )
    draws = {
        "mujoco.Renderer": (FEW, lambda: reference.pictures(*few)),
        "MuJoCo Warp, on the CPU": (WORLDS, lambda: warp.frames(*several)),
        "fast camera": (BATCH, lambda: fast.frames(*scenes)),
        "fast camera, expanded to the network's input": (BATCH, lambda: network_input(fast.frames(*scenes))),
    }
    seconds = taking_turns({name: draw for name, (_, draw) in draws.items()}, rounds)
    return {name: frames / seconds[name] for name, (frames, _) in draws.items()}
