"""Everything that learns from reward: the shared PPO update, the executor, the route head (Section Implementation)."""
