"""Which corridor: the paper's own decision."""

from lt_lib.beyond.tasks.task import Task, binary, chosen

TASK = Task(
    "which corridor",
    reward=lambda scenes: chosen(1 - scenes.slab, 2),  # the one without the mat
    bits=lambda scenes: binary(scenes.slab, 1),
)
