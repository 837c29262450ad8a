"""Will exploration ever sample the decision? The scalar predictor z (Section 'A scalar predictor of learnability').

Ask about your own task in three lines; lengths in metres, times in seconds, sigma in units of full command:

    from lt_lib.learnability.predictor import ask
    answer = ask(distance=1.25, speed=0.5, period=0.1, window=30, sigma=0.601)
    print(answer)

The verdict comes from the curve that the point-mass study (notebook 06) fitted and saved; no number is typed in.
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
from lt_lib.store.files import content_digest

CURVES = Path("curves") / "learnability.json"  # in a profile's outputs
LEARNABLE, BORDERLINE, UNLEARNABLE = "learnable", "borderline", "unlearnable"
SURE = 0.9  # a task is learnable if at least this share of runs solves it, unlearnable below 1 - SURE
CONFIDENCE = 0.95  # of the interval that must lie beyond these shares
FARTHEST = 10.0  # full-speed windows; a larger distance is a unit error


def z_score(d: Any, window: Any, sigma: Any) -> Any:
    """Distance from a zero-mean policy's window mean to d in standard deviations, Eq. z; broadcasts."""
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
        """Percentile interval of the share solved, over the replicates."""
        centre, width = np.transpose(self.replicates)[..., None]
        shares = expit((centre - np.ravel(z)) / width)
        low, high = np.quantile(shares, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
        return low.reshape(np.shape(z)), high.reshape(np.shape(z))


class Curves(Settings):
    """The study's curves by name, and the name of the default one."""

    main: str
    curves: dict[str, Curve]


def load_curve(name: str = "", path: Path = ROOT / "outputs" / "full" / CURVES) -> Curve:
    """A curve of the point-mass study from a profile's outputs, such as '100 updates'; '' is the main one.

    Raises a one-line UserError if it is missing or unreadable.
    """
    try:
        content = dict(json.loads(path.read_text(encoding="utf-8")))
        if content.pop("sha256", None) != content_digest(content):
            raise UserError(f"{path.name}: was altered (its checksum differs); run notebook 06 again")
        kept = Curves.model_validate(content)
    except FileNotFoundError:
        where = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
        raise UserError(f"no curve at {where}; create it with `python run_all.py --only z_study`") from None
    except ValidationError as error:
        raise UserError(explain(error, path.name, Curves)) from None
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{path.name}: cannot be read: {error}") from None
    if (name or kept.main) not in kept.curves:
        raise UserError(f"{path.name}: no curve {name or kept.main!r}; known: {', '.join(kept.curves)}")
    return kept.curves[name or kept.main]


@dataclass(frozen=True)
class Task:
    """A lateral decision under velocity commands.

    distance  lateral metres to the alternative
    speed     m/s at full lateral command
    period    seconds per control step
    window    control steps within which the decision is made
    sigma     standard deviation of one step's command, in units of full command

    Raises a one-line UserError for an impossible value or one that suggests the wrong unit.
    """

    distance: Any  # untyped, so that our own message rejects a non-number
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
        """Metres per step at full lateral command."""
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
        """Probability that a window of zero-mean iid Gaussian commands averages d or more; upper bound, see paper."""
        return float(norm.sf(self.z))


@dataclass(frozen=True)
class Answer:
    """The predictor's answer for a task, and the curve behind it."""

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
        """Learnable or unlearnable if the whole interval lies beyond SURE or 1 - SURE, otherwise borderline.

        With d above 1, even full command in every step falls short.
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
    """The predictor's answer for a task (arguments as in Task); the default curve is the full study's main one."""
    return Answer(Task(distance, speed, period, window, sigma), curve or load_curve())


def scene_task(layout: Layout, sigma: float) -> Task:
    """The decision in our own scene: from the spawn to the centre of the farther mouth, on the way to the barrier."""
    mouths = [corridor.legs[0] for corridor in layout.routes]
    distance = max(abs(sum(mouth.y) / 2 - layout.spawn.y) for mouth in mouths)
    approach = min(mouth.x[0] for mouth in mouths) - layout.spawn.x
    return Task(distance, V_MAX, 1 / CONTROL_HZ, round(approach * CONTROL_HZ / V_MAX), sigma)
