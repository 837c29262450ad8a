"""The task for other people's learners, in Gymnasium and PettingZoo."""
