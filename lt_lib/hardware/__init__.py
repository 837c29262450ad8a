"""Hardware decode (Section Hardware): matched optics, the surrogate camera, sessions, the probe."""
