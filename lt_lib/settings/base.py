"""What all settings share: their base, the scene and the device, and the one-line error for people."""

import hashlib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, computed_field, model_validator

ROOT = Path(__file__).resolve().parents[2]


class UserError(Exception):
    """A mistake in what a person gave us; its one line names it and says what would be right."""


def require_known(names: Iterable[str], known: Collection[str], what: str, where: str = "") -> None:
    """Raises UserError for the first of the names of some `what` that is not a known one; `where`: 'seeds: '."""
    for name in names:
        if name not in known:
            raise UserError(f"{where}unknown {what} {name!r}; there are {', '.join(known)}")


def read_yaml(path: Path) -> Any:
    """What a yaml file holds. Raises UserError, one line, if it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise UserError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None


def _frozen(value: Any) -> Any:
    """Lists as tuples, at any depth, since yaml and notebooks can only write lists."""
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


class Settings(BaseModel):
    """Base of every configuration: immutable, strictly typed, no unknown keys; lists are taken for tuples."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
    decided: ClassVar[tuple[str, ...]] = ()  # fields that a study decides, run by run; a profile may not set them

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, values: Any) -> Any:
        if isinstance(values, dict):
            return {name: _frozen(value) for name, value in values.items()}
        return values


LAYOUTS = ROOT / "params" / "layouts"


def layout_path(name: str) -> Path:
    """The file of a layout: params/layouts/<name>.yaml, or the path of any yaml file.

    Raises UserError for an unknown name.
    """
    path = Path(name) if name.endswith(".yaml") else LAYOUTS / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in LAYOUTS.glob("*.yaml")))
        raise UserError(f"unknown layout '{name}'; known: {known}, or the path of a .yaml file")
    return path


Share = Annotated[float, Field(ge=0, le=1)]


Precision = Literal["float32", "bfloat16"]
LATENCY = 1  # control steps between sending and arriving, the paper's


class Scene(Settings):
    """What every run shares: the scene."""

    decided = ("layout",)
    layout: str = "default"

    @computed_field
    @property
    def layout_digest(self) -> str:
        """sha256 of the layout's file, so that an edited scene is another setting."""
        return hashlib.sha256(layout_path(self.layout).read_bytes()).hexdigest()


class Training(Scene):
    """What every run with a pixel encoder shares: the scene, and the device that computes it."""

    decided = ("layout", "device")
    device: Literal["cpu", "cuda"] = "cpu"


def everywhere(settings: Any, shared: Mapping[str, Any]) -> Any:
    """Settings with what is shared put into those of its fields that they have; anything else as it is."""
    if not isinstance(settings, Settings):
        return settings
    return settings.model_copy(update={name: value for name, value in shared.items() if hasattr(settings, name)})


def refuse_decided(value: Any, name: str) -> None:
    """Raises UserError if settings, at any depth, were given a field that their study decides run by run."""
    if isinstance(value, Settings):
        for field in value.model_fields_set:
            if field in value.decided:
                raise UserError(f"{name}.{field}: the study decides this, run by run; leave it out")
            refuse_decided(getattr(value, field), f"{name}.{field}")
