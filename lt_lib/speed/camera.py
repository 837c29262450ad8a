"""How much faster the fast camera is than `mujoco.Renderer` (Section Setup)."""

import numpy as np
from jaxtyping import Float

from lt_lib.envs.camera import FastCamera, network_input
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.speed.turns import taking_turns

BATCH, SLOW_BATCH = 256, 32  # frames per turn: as many as training requests at once, and fewer for the slow renderer


def frame_rates(
    fast: FastCamera,
    reference: ReferenceCamera,
    eyes: Float[np.ndarray, "b 3"],
    slabs,
    others: Float[np.ndarray, "b 2"],
    rounds: int = 5,
) -> dict[str, float]:
    """Frames per second of processor time: the median over rounds in which the cameras take turns.

    Processor time includes all threads of this process, so these are rates of one core. A renderer on a GPU would hide
    its work from this clock. Arguments as for `FastCamera.frames`.
    """
    scenes = [values[np.arange(BATCH) % len(eyes)] for values in (eyes, np.asarray(slabs), others)]
    few = [values[:SLOW_BATCH] for values in scenes]
    draws = {
        "mujoco.Renderer": (SLOW_BATCH, lambda: reference.pictures(*few)),
        "fast camera": (BATCH, lambda: fast.frames(*scenes)),
        "fast camera, expanded to the network's input": (BATCH, lambda: network_input(fast.frames(*scenes))),
    }
    seconds = taking_turns({name: draw for name, (_, draw) in draws.items()}, rounds)
    return {name: frames / seconds[name] for name, (frames, _) in draws.items()}
