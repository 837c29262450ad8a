"""From frames to frozen latents (Section Encoder and freeze)."""
