"""What the fast paths buy: every side-by-side timing (notebook 10)."""
