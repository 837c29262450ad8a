"""The settings that every policy shares."""

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from lt_lib.settings.base import Settings, Share


class PpoConfig(Settings):
    """The settings that every policy, seed and condition shares (Section Implementation)."""

    clip: PositiveFloat = 0.2
    epochs: PositiveInt = 4
    entropy: NonNegativeFloat = 0.01
    gamma: Share = 0.99
    lam: Share = 0.95
