"""Whether a second robot stands on the scout's side."""

from lt_lib.beyond.tasks.task import Task, binary, chosen

TASK = Task(
    "is the side clear",
    reward=lambda scenes: chosen(scenes.company.astype(int), 2),
    bits=lambda scenes: binary(scenes.company.astype(int), 1),
)
