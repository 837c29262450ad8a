"""The scene: one layout, its physics, its camera (Section Setup)."""
