"""Settings of the point-mass study."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from lt_lib.settings.base import Settings

UPDATES_PER_LOOK = 25  # updates between two looks at the point-mass study


Budget = Annotated[int, Field(gt=0, multiple_of=UPDATES_PER_LOOK)]


class PointMassConfig(Settings):
    """One stack of the point-mass study: every d with every sigma at one window length (Section Scalar predictor)."""

    arm: Literal["gaussian", "no_signal", "categorical", "unclamped"] = "gaussian"
    window: PositiveInt = 30  # control steps N
    distances: tuple[PositiveFloat, ...] = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.1, 1.3)
    sigmas: tuple[PositiveFloat, ...] = (0.55, 1.0)
    seeds: PositiveInt = 5
    optimiser: Literal["adam", "sgd"] = "adam"
    baseline: Literal["batch", "message"] = "batch"  # mean reward of the batch, or of its episodes with this message
    score: Literal["sum", "mean"] = "sum"  # of a window: over its steps
    lr: PositiveFloat = 0.02
    batch: Annotated[int, Field(ge=2)] = 128  # episodes per update
    budgets: Annotated[tuple[Budget, ...], Field(min_length=1)] = (
        1_000,
    )  # updates after which success is measured, increasing; the last ends the training
    evaluation: PositiveInt = 8_192  # episodes per measurement

    @model_validator(mode="after")
    def _budgets_in_order(self) -> "PointMassConfig":
        if list(self.budgets) != sorted(set(self.budgets)):
            raise ValueError(f"budgets must increase, got {list(self.budgets)}")
        return self
