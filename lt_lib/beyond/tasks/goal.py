"""Where the goal stands, of three places."""

from lt_lib.beyond.rich import GOALS
from lt_lib.beyond.tasks.task import Task, binary, chosen

TASK = Task(
    "which goal",
    reward=lambda scenes: chosen(scenes.goal, len(GOALS)),
    bits=lambda scenes: binary(scenes.goal, 2),
)
