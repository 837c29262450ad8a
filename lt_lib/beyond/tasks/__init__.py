"""Decisions that read one broadcast, each from its own reward; to add one, write a file and list it here."""

from lt_lib.beyond.tasks import company, corridor, depth, detour, goal

TASKS = {task.words: task for task in (corridor.TASK, depth.TASK, goal.TASK, company.TASK, detour.TASK)}
