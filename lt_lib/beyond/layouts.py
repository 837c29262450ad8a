"""Other arenas of the same kind: two bent corridors whose slab shows from beyond the barrier alone.

python -m lt_lib.beyond.layouts      writes params/layouts/sampled_<i>.yaml again
"""

from collections.abc import Sequence

import numpy as np
import yaml

from lt_lib.envs.layout import Layout, load_layout
from lt_lib.envs.occlusion import require_occlusion
from lt_lib.settings.base import LAYOUTS, UserError
from lt_lib.settings.streams import Stream

SAMPLED = ("sampled_0", "sampled_1", "sampled_2")


def sample_layout(name: str, rng: np.random.Generator) -> Layout:
    """An arena with barrier, corridors, slab and scout of random size and place that passes the occlusion check.

    Both corridors are mirror images, as in the paper. Lengths are rounded to centimetres.
    """
    while True:
        try:
            layout = Layout(**proposed(name, rng))
            require_occlusion(layout)
        except (UserError, ValueError):  # a corridor that cuts another, a robot in a wall, a slab in sight
            continue
        return layout


def proposed(name: str, rng: np.random.Generator) -> dict:
    """The default layout's values with random geometry; nothing says yet that it is possible."""
    near, far = -rng.uniform(1.2, 1.8), rng.uniform(1.0, 1.5)  # faces of the barrier
    wide, bend = rng.uniform(0.5, 0.75), rng.uniform(0.4, 0.7)  # of the corridors, and of their bends along x
    mouth, out = rng.uniform(0.7, 1.5), rng.uniform(0.05, 0.5)  # inner edges, from the centre line
    turn = rng.uniform(near + 0.9, far - 0.9)  # where the bend begins
    slab = far - 0.3, far + 0.3
    legs = [
        ((near, turn + bend), (mouth, mouth + wide)),
        ((turn, turn + bend), (out, mouth + wide)),
        ((turn, far), (out, out + wide)),
    ]
    left = {"legs": [rect(x, y) for x, y in legs], "slab": rect(slab, (out, out + wide))}
    right = {
        "legs": [rect(x, _mirrored(y)) for x, y in legs],
        "slab": rect(slab, _mirrored((out, out + wide))),
    }
    values = load_layout("default").model_dump(mode="json")
    values["scout"] |= {"x": cm(far + rng.uniform(0.9, 1.6))}
    points = [{"x": cm(near - 0.3), "y": cm(side * (mouth + wide / 2)), "heading": 0.0} for side in (1, -1)]
    return values | {
        "name": name,
        "barrier": [cm(near), cm(far)],
        "corridors": {"left": left, "right": right},
        "choice_points": points,
    }


def rect(x: Sequence[float], y: Sequence[float]) -> dict:
    """A layout's rectangle, to the centimetre."""
    return {"x": [cm(value) for value in x], "y": [cm(value) for value in y]}


def _mirrored(y: tuple[float, float]) -> tuple[float, float]:
    return -y[1], -y[0]


def cm(value: float) -> float:
    """Metres, to the centimetre."""
    return round(float(value), 2)


def written(layout: Layout) -> str:
    """A layout as the text of its YAML file."""
    head = "# Made in lt_lib/beyond; lengths in metres, angles in degrees.\n"
    return head + yaml.safe_dump(layout.model_dump(mode="json"), sort_keys=False, default_flow_style=None)


def sampled_layouts() -> dict[str, Layout]:
    """The arenas of the variance split, by name."""
    return {name: sample_layout(name, Stream.LAYOUTS.generator(0, name)) for name in SAMPLED}


def write(layout: Layout) -> None:
    """Writes a layout's file among the project's."""
    (LAYOUTS / f"{layout.name}.yaml").write_text(written(layout), encoding="utf-8")


if __name__ == "__main__":
    for layout in sampled_layouts().values():
        write(layout)
