"""Will exploration ever sample the decision? The scalar predictor z (Section 'A scalar predictor of learnability').

Ask about a task of your own in three lines; lengths in metres, times in seconds, sigma in units of full command:

    from lt_lib.learnability.predictor import ask
    answer = ask(distance=1.25, speed=0.5, period=0.1, window=30, sigma=0.601)
    print(answer)

The verdict comes from a curve that the point-mass study (notebook 06) fitted and kept; it is read, never typed.
"""

import json
from dataclasses import dataclass
from math import isfinite
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveFloat, ValidationError
from scipy.special import expit
from scipy.stats import norm

from lt_lib.envs.arena import CONTROL_HZ, V_MAX
from lt_lib.envs.layout import Layout
from lt_lib.settings.base import ROOT, Settings, UserError
from lt_lib.settings.profiles import explain

CURVES = Path("curves") / "learnability.json"  # in the outputs of a profile
LEARNABLE, BORDERLINE, UNLEARNABLE = "learnable", "borderline", "unlearnable"
SURE = 0.9  # share of runs solved from which a task counts as learnable; below 1 - SURE it is unlearnable
CONFIDENCE = 0.95  # of the interval that has to lie beyond those shares
FARTHEST = 10.0  # full-speed windows; a larger distance is a slip of units


def z_score(d: Any, window: Any, sigma: Any) -> Any:
    """Standard deviations from a zero-mean policy's window mean to d, Eq. z; broadcasts."""
    return d * np.sqrt(window) / sigma


class Curve(Settings):
    """Share of runs that solve a task at z: 1 / (1 + exp((z - centre) / width)), with its bootstrap replicates."""

    centre: float
    width: PositiveFloat
    replicates: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]  # (centre, width) each
    made_of: str

    def solved(self, z: Any) -> Any:
        return expit((self.centre - np.asarray(z)) / self.width)

    def interval(self, z: Any) -> tuple[Any, Any]:
        """Of the share solved: percentiles over the replicates."""
        centre, width = np.transpose(self.replicates)[..., None]
        shares = expit((centre - np.ravel(z)) / width)
        low, high = np.quantile(shares, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
        return low.reshape(np.shape(z)), high.reshape(np.shape(z))


class Curves(Settings):
    """The curves that the study left, by name, and the name of the one that answers unless another is asked for."""

    main: str
    curves: dict[str, Curve]


def load_curve(name: str = "", path: Path = ROOT / "outputs" / "full" / CURVES) -> Curve:
    """A curve that the point-mass study left in the outputs of a profile, such as '100 updates'; '' is its main one.

    Raises UserError, one line, where there is none or it cannot be read.
    """
    try:
        kept = Curves.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        where = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
        raise UserError(f"no curve at {where}; `python run_all.py --only z_study` makes it") from None
    except ValidationError as error:
        raise UserError(explain(error, path.name, Curves)) from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path.name}: cannot be read: {error}") from None
    if (name or kept.main) not in kept.curves:
        raise UserError(f"{path.name}: no curve {name or kept.main!r}; there are {', '.join(kept.curves)}")
    return kept.curves[name or kept.main]


@dataclass(frozen=True)
class Task:
    """A lateral decision under velocity commands.

    distance  metres sideways to the alternative
    speed     m/s at full lateral command
    period    seconds of a control step
    window    control steps within which the decision falls
    sigma     standard deviation of one step's command, in units of full command

    Raises UserError, one line, for a value that cannot be, or that betrays another unit.
    """

    distance: Any  # typed as anything, so that what is no number is refused in our words
    speed: Any
    period: Any
    window: Any
    sigma: Any

    def __post_init__(self) -> None:
        units = {"distance": "metres", "speed": "m/s", "period": "seconds", "sigma": "full commands"}
        for name, unit in units.items():
            value = getattr(self, name)
            if not isinstance(value, Real) or isinstance(value, bool) or not (isfinite(value) and value > 0):
                raise UserError(f"{name}: must be a positive number of {unit}, got {value!r}")
        if not isinstance(self.window, Integral) or isinstance(self.window, bool) or self.window < 1:
            raise UserError(f"window: must be a whole number of control steps, at least 1, got {self.window!r}")
        self._check_units()

    def _check_units(self) -> None:
        if self.d > FARTHEST:
            raise UserError(
                f"distance: {self.distance:g} m is {self.d:.0f} times what full speed covers in the window; "
                "give metres, m/s and seconds (is it in centimetres?)"
            )
        if self.distance < self.step:
            raise UserError(
                f"period: one step of full command covers {self.step:g} m, more than the distance of "
                f"{self.distance:g} m; give metres, m/s and seconds (is it in milliseconds or Hz?)"
            )
        if self.sigma > FARTHEST:
            raise UserError(f"sigma: {self.sigma:g} full commands; divide it by the full command if it is in m/s")

    @property
    def step(self) -> float:
        """Metres of one step of full lateral command."""
        return self.speed * self.period

    @property
    def d(self) -> float:
        """Mean normalised lateral command that reaches the alternative within the window."""
        return self.distance / (self.step * self.window)

    @property
    def z(self) -> float:
        return float(z_score(self.d, self.window, self.sigma))

    @property
    def probability(self) -> float:
        """That the mean of a window of iid Gaussian commands about zero reaches d; an upper bound, see the paper."""
        return float(norm.sf(self.z))


@dataclass(frozen=True)
class Answer:
    """What the predictor says of a task, and the curve that it says it from."""

    task: Task
    curve: Curve

    @property
    def z(self) -> float:
        return self.task.z

    @property
    def probability(self) -> float:
        return self.task.probability

    @property
    def solved(self) -> float:
        """Expected share of training runs that solve a decision at this z."""
        return float(self.curve.solved(self.z))

    @property
    def interval(self) -> tuple[float, float]:
        low, high = self.curve.interval(self.z)
        return float(low), float(high)

    @property
    def verdict(self) -> str:
        """Learnable or unlearnable where the whole interval lies beyond SURE or 1 - SURE, borderline between.

        With d above 1 not even full command in every step arrives in time.
        """
        low, high = self.interval
        if self.task.d > 1 or high <= 1 - SURE:
            return UNLEARNABLE
        return LEARNABLE if low >= SURE else BORDERLINE

    def __str__(self) -> str:
        low, high = self.interval
        beyond = f" (d = {self.task.d:.2f}: full command falls short)" if self.task.d > 1 else ""
        return (
            f"{self.verdict}{beyond}: z = {self.z:.2f}, probability {self.probability:.1e} a window, "
            f"share of runs that solve it {self.solved:.2f} [{low:.2f}, {high:.2f}]; {self.curve.made_of}"
        )


def ask(distance: Any, speed: Any, period: Any, window: Any, sigma: Any, curve: Curve | None = None) -> Answer:
    """What the predictor says of a task (arguments as in Task), from the full study's main curve if none is given."""
    return Answer(Task(distance, speed, period, window, sigma), curve or load_curve())


def scene_task(layout: Layout, sigma: float) -> Task:
    """The decision in our own scene: from the spawn to the middle of the farther mouth, on the way to the barrier."""
    mouths = [corridor.legs[0] for corridor in layout.routes]
    distance = max(abs(sum(mouth.y) / 2 - layout.spawn.y) for mouth in mouths)
    approach = min(mouth.x[0] for mouth in mouths) - layout.spawn.x
    return Task(distance, V_MAX, 1 / CONTROL_HZ, round(approach * CONTROL_HZ / V_MAX), sigma)
