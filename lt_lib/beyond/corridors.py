"""Arenas with C corridors from one generator: physics, camera, occlusion check and executor follow from the layout.

    python -m lt_lib.beyond.corridors      writes params/layouts/corridors_*.yaml again

All corridors are alike, side by side, and bend the same way; the arena, the scout's distance and the goal's grow with
their number, so that the scout still sees every slab. Any number of corridors can be blocked at a time. Walls have no
friction: what is asked is which corridor is chosen, and with friction a controller may stay in a bend for good.
"""

import numpy as np

from lt_lib.beyond.layouts import cm, rect, write
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.envs.occlusion import require_occlusion

# name -> corridors, and how many of them are blocked at a time
ARENAS = {f"corridors_{count}": (count, (count - 1,)) for count in (2, 3, 4, 6)} | {
    "corridors_4_one": (4, (1,)),
    "corridors_4_two": (4, (2,)),
    "corridors_4_any": (4, (1, 2, 3)),
}
PITCH, OFFSET, HALF = 1.7, 0.95, 0.3  # metres: between corridors, from mouth to exit, half a corridor's width
MARGIN = 1.1  # of the scout's distance, over the one from which it just sees the outermost slabs


def corridor_layout(name: str) -> Layout:
    """An arena of ARENAS, its corridors numbered from the left.

    Raises UserError if the navigator sees a slab from where it chooses, or the scout does not see one.
    """
    count, blocked = ARENAS[name]
    values = load_layout("default").model_dump(mode="json")
    near, far = values["barrier"]
    mouths = [(count - 1) / 2 * PITCH + OFFSET / 2 - i * PITCH for i in range(count)]
    exits = [mouth - OFFSET for mouth in mouths]
    outer, middle = mouths[0] + HALF + 0.5, (exits[0] + exits[-1]) / 2
    sight = np.tan(np.deg2rad(values["camera"]["fov"] / 2))
    scout = far + HALF + MARGIN * (exits[0] - middle + HALF) / sight
    layout = Layout(
        **values
        | {
            "name": name,
            "blocked": blocked,
            "robot": values["robot"] | {"friction": 0.0},
            "arena": {"x": [values["arena"]["x"][0], cm(scout + 3.0)], "y": [cm(-outer), cm(outer)]},
            "corridors": [_corridor(near, far, mouth, out) for mouth, out in zip(mouths, exits, strict=True)],
            "scout": values["scout"] | {"x": cm(scout), "y": cm(middle)},
            "goal": values["goal"] | {"x": cm(scout + 2.0), "y": cm(middle)},
            "choice_points": [{"x": cm(near - 0.3), "y": cm(mouth), "heading": 0.0} for mouth in mouths],
        }
    )
    require_occlusion(layout)
    return layout


def _corridor(near: float, far: float, mouth: float, out: float) -> dict:
    legs = [
        ((near, 0.6), (mouth - HALF, mouth + HALF)),
        ((0.0, 0.6), (out - HALF, mouth + HALF)),
        ((0.0, far), (out - HALF, out + HALF)),
    ]
    return {"legs": [rect(x, y) for x, y in legs], "slab": rect((far - HALF, far + HALF), (out - HALF, out + HALF))}


if __name__ == "__main__":
    for name in ARENAS:
        write(corridor_layout(name))
