"""From results to verdicts: statistics, the paper's claims, the scoreboard and its figure."""
