"""The task for other people's learners: Gymnasium and PettingZoo."""
