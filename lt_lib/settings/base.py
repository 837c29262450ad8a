"""What all settings share: their base, the scene, the device, and the one-line error for users."""

import hashlib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, computed_field, model_validator

ROOT = Path(__file__).resolve().parents[2]


class UserError(Exception):
    """A mistake in the user's input; its one line names the mistake and says what is expected."""


def require_known(names: Iterable[str], known: Collection[str], what: str, where: str = "") -> None:
    """Raises UserError for the first unknown name of a `what`; `where` is a prefix such as 'seeds: '."""
    for name in names:
        if name not in known:
            raise UserError(f"{where}unknown {what} {name!r}; known: {', '.join(known)}")


def _frozen(value: Any) -> Any:
    """Lists as tuples, at any depth, since YAML and notebooks can only write lists."""
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


class Settings(BaseModel):
    """Base of every configuration: immutable, strictly typed, no unknown keys; lists become tuples."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
    decided: ClassVar[tuple[str, ...]] = ()  # fields that a study sets for each run; a profile may not set them

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, values: Any) -> Any:
        if isinstance(values, dict):
            return {name: _frozen(value) for name, value in values.items()}
        return values

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> "Settings":
        """A copy with some fields replaced; nothing that was computed from the old ones comes along."""
        copied = super().model_copy(update=update, deep=deep)
        for computed in copied.__dict__.keys() - type(copied).model_fields.keys():
            del copied.__dict__[computed]
        return copied


LAYOUTS = ROOT / "params" / "layouts"


def layout_path(name: str) -> Path:
    """The file of a layout: params/layouts/<name>.yaml, or the path of any YAML file.

    Raises UserError for an unknown name.
    """
    path = Path(name) if name.endswith(".yaml") else LAYOUTS / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in LAYOUTS.glob("*.yaml")))
        raise UserError(f"unknown layout '{name}'; known: {known}, or the path of a .yaml file")
    return path


Share = Annotated[float, Field(ge=0, le=1)]


LATENCY = 1  # control steps from sending to arrival, as in the paper


class Scene(Settings):
    """What every run shares: the scene."""

    decided = ("layout",)
    layout: str = "default"

    @computed_field
    @property
    def layout_digest(self) -> str:
        """sha256 of the layout's file, so that an edited scene is a different setting."""
        return hashlib.sha256(layout_path(self.layout).read_bytes()).hexdigest()


class Training(Scene):
    """What every run with a pixel encoder shares: the scene, and the device that computes it."""

    decided = ("layout", "device")
    device: Literal["cpu", "cuda"] = "cpu"


def require_looks(looks: Iterable[int], update: int, steps: int) -> None:
    """Raises ValueError for a look that does not fall between two updates of a training, all in control steps."""
    for look in looks:
        if look % update or look > steps:
            raise ValueError(f"looks: expected multiples of {update} up to {steps} control steps, got {look}")


def everywhere(settings: Any, shared: Mapping[str, Any]) -> Any:
    """Settings with the shared values that they have fields for; anything else unchanged."""
    if not isinstance(settings, Settings):
        return settings
    return settings.model_copy(update={name: value for name, value in shared.items() if hasattr(settings, name)})


def refuse_decided(value: Any, name: str) -> None:
    """Raises UserError if settings, at any depth, were given a field that their study sets for each run."""
    if isinstance(value, Settings):
        for field in value.model_fields_set:
            if field in value.decided:
                raise UserError(f"{name}.{field}: the study sets this for each run; leave it out")
            refuse_decided(getattr(value, field), f"{name}.{field}")
