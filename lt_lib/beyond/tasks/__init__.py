"""Decisions that read one broadcast, each from its own reward; to add one, write a file and list it here."""

from lt_lib.beyond.tasks import company, corridor, depth, detour, fixed_detour, goal

ANSWERS = (corridor.TASK, depth.TASK, goal.TASK, company.TASK)  # with one right answer in every scene
COSTS = (fixed_detour.TASK, detour.TASK)  # through the mat or round it
TASKS = {task.words: task for task in (*ANSWERS, *COSTS)}
