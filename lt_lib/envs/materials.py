"""The palette index and colour of every visible material. The scene is flat-lit, so an index is a colour."""

import numpy as np

# One colour per face direction, so that a corner between two walls of one material is visible.
MATERIALS = {
    "sky": (190, 215, 235),
    "floor": (120, 110, 100),
    "wall_x": (205, 200, 190),
    "wall_y": (165, 160, 155),
    "barrier_x": (95, 120, 160),
    "barrier_y": (60, 80, 120),
    "slab_x": (215, 40, 35),
    "slab_y": (165, 25, 25),
    "slab_z": (235, 80, 70),
    "goal": (60, 170, 75),
    "robot": (235, 190, 60),
}
INDEX = {name: i for i, name in enumerate(MATERIALS)}
PALETTE = np.array(list(MATERIALS.values()), dtype=np.uint8)  # (11, 3)
HAZARD = np.array([name.startswith("slab") for name in MATERIALS])  # (11,)
WALLS = np.array([name.startswith(("wall", "barrier")) for name in MATERIALS])  # (11,)
GOAL_PILLAR = (0.2, 0.6)  # radius and height, metres; thinner than the goal region, so a robot never touches it
