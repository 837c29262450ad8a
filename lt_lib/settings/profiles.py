"""The profiles that run_all.py gives to notebooks, every value checked."""

import ast
import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    TypeAdapter,
    ValidationError,
)

from lt_lib.settings.base import ROOT, Share, UserError, refuse_decided, require_known
from lt_lib.settings.beyond import (
    Bits,
    Chance,
    ControlsConfig,
    DeciderSizes,
    Directions,
    LoopSizes,
    MovingSizes,
    Quality,
    Rung,
)
from lt_lib.settings.gridworld import GridworldConfig, Scaled
from lt_lib.settings.hardware import MatchedEncoderConfig, MatchedGateConfig, RailsConfig, SessionsConfig
from lt_lib.settings.learnability import Budget, PointMassConfig
from lt_lib.settings.pixels import ExecutorConfig, PixelsConfig
from lt_lib.settings.speed import Stretch
from lt_lib.settings.strict_yaml import read_yaml
from lt_lib.settings.velocity import Configuration, NavigatorConfig, PretrainingConfig, RolloutConfig

# What run_all.py gives to every notebook; a profile may not
GIVEN = ("profile", "outputs", "workers")
NO_PROFILES = ("claims", "inferred", "predictions")  # files in params/ with another content


def profile_names(root: Path = ROOT) -> list[str]:
    """The profiles of a project: every YAML file in params/ but those of the paper."""
    return sorted(
        path.stem for path in (root / "params").glob("*.yaml") if path.stem not in ("claims", "inferred", "predictions")
    )


def notebook_names(root: Path = ROOT) -> list[str]:
    """The notebooks of a project in numeric order, e.g. '04_pixels'; copies such as '04_pixels-Copy1' are none."""
    stems = (path.stem for path in (root / "notebooks").glob("*.ipynb"))
    return sorted(stem for stem in stems if re.fullmatch(r"\d\d_[a-z0-9_]+", stem))


def notebook_defaults(path: Path) -> dict[str, Any]:
    """The names and literal values assigned in a notebook's one cell tagged 'parameters'."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    tagged = [cell for cell in cells if "parameters" in cell["metadata"].get("tags", [])]
    if len(tagged) != 1:
        raise UserError(f"{path.name}: expected exactly one cell tagged 'parameters', found {len(tagged)}")
    body = ast.parse("".join(tagged[0]["source"])).body
    try:
        return {node.targets[0].id: ast.literal_eval(node.value) for node in body}
    except (AttributeError, ValueError):
        raise UserError(f"{path.name}: its parameters cell may hold only name = literal") from None


def load_profile(name: str, root: Path = ROOT) -> dict[str, dict[str, Any]]:
    """What a profile gives to each notebook, checked: {notebook: {parameter: value}}.

    A notebook's own section overrides `shared`, whose keys reach every notebook that declares them. A value replaces
    the notebook's whole default, dicts included.

    Raises UserError for an unknown profile, notebook or parameter, or a value of the wrong type or range.
    """
    require_known([name], profile_names(root), "profile")
    folder = root / "notebooks"
    defaults = {book: notebook_defaults(folder / f"{book}.ipynb") for book in notebook_names(root)}
    sections = _read_sections(root / "params" / f"{name}.yaml", defaults)
    shared = sections.pop("shared", {})
    profile = {}
    for book, declared in defaults.items():
        given = {key: value for key, value in shared.items() if key in declared} | sections.get(book, {})
        for key, value in given.items():
            _check_value(f"{name}.yaml: {book}", key, value, declared)
        profile[book] = given
    return profile


def _read_sections(path: Path, defaults: Mapping[str, Mapping]) -> dict[str, dict[str, Any]]:
    """The sections of a profile's file. Raises UserError for an unknown notebook or shared parameter."""
    sections = read_yaml(path) or {}
    if not isinstance(sections, dict):
        raise UserError(f"{path.name}: expected sections such as 'shared:', got {sections!r}")
    for section, values in sections.items():
        if section != "shared":
            require_known([section], defaults, "notebook", f"{path.name}: ")
        if not isinstance(values, dict):
            raise UserError(f"{path.name}: {section}: expected its parameters below it, got {values!r}")
        for key in set(values) & set(GIVEN):
            raise UserError(f"{path.name}: {section}: {key} comes from the command line (--{key}); leave it out")
    declared = {key for names in defaults.values() for key in names}
    for key in sections.get("shared", {}):
        if key not in declared:
            known = _listed(declared)
            raise UserError(f"{path.name}: shared: no notebook declares {key!r}; known: {known}")
    return sections


def _check_value(where: str, key: str, value: Any, declared: Mapping[str, Any]) -> None:
    """A parameter must be declared by its notebook, have the type of its default, and satisfy SECTIONS."""
    if key not in declared:
        raise UserError(f"{where}: unknown parameter {key!r}; known: {_listed(declared)}")
    if not _same_type(value, declared[key]):
        expected = type(declared[key]).__name__
        raise UserError(f"{where}: {key}: expected {expected} such as {declared[key]!r}, got {value!r}")
    if key in SECTIONS:
        try:
            validated(SECTIONS[key], key, value)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None
    elif isinstance(value, dict):
        raise UserError(f"{where}: {key}: SECTIONS has no settings for it; known: {_listed(SECTIONS)}")


def validated(kind: Any, name: str, value: Any) -> Any:
    """A notebook's or profile's parameter as validated settings. Raises a one-line UserError if it is unusable."""
    try:
        settings = TypeAdapter(kind).validate_python(value, strict=True)
    except ValidationError as error:
        raise UserError(explain(error, name, kind)) from None
    refuse_decided(settings, name)
    return settings


def _same_type(value: Any, default: Any) -> bool:
    """Whether a value may replace a default: the same type, int for float, lists item by item."""
    if isinstance(default, list) and isinstance(value, list) and default:
        return all(any(_same_type(item, example) for example in default) for item in value)
    return type(value) is type(default) or (type(default) is float and type(value) is int)


def explain(error: ValidationError, name: str, settings: Any) -> str:
    """Pydantic's first complaint in one line, e.g. 'encoder.frames: must be greater than 0, got -1'."""
    first = error.errors()[0]
    place = ".".join([name, *map(str, first["loc"])])
    if first["type"] == "extra_forbidden":
        for part in first["loc"][:-1]:
            settings, name = _inside(settings, part), f"{name}.{part}"
        return f"{place}: unknown parameter; {name} has {_listed(set(settings.model_fields) - set(settings.decided))}"
    complaint = first["msg"].replace("Input should be", "must be")
    return f"{place}: {complaint}, got {first['input']!r}"


def _inside(settings: Any, part: str | int) -> Any:
    """The type of a field of settings, or of the items of a list or dict of settings."""
    if hasattr(settings, "model_fields"):
        return settings.model_fields[part].annotation
    if get_origin(settings) is Annotated:
        return _inside(get_args(settings)[0], part)
    return next(kind for kind in reversed(get_args(settings)) if kind is not ...)


def _with(needed: Collection[Any]) -> AfterValidator:
    """A list must hold some values, about which something was predicted (params/predictions.yaml)."""

    def check(values: list[Any]) -> list[Any]:
        for value in needed:
            if value not in values:
                raise ValueError(f"must hold {value!r}, about which a prediction was written down")
        return values

    return AfterValidator(check)


def _listed(names: Any) -> str:
    return ", ".join(sorted(names))


# How profile and notebook parameters of these names are checked: settings by their class, others by type.
SECTIONS: dict[str, Any] = {
    "pixel_study": PixelsConfig,
    "executor": ExecutorConfig,
    "gridworld": GridworldConfig,
    "peek_seeds": dict[str, PositiveInt],
    "poses": PositiveInt,
    "pixels": PositiveInt,
    "ablation_seeds": PositiveInt,
    "variant_seeds": PositiveInt,
    "forms": Annotated[list[Scaled], Field(min_length=2)],
    "form_seeds": PositiveInt,
    "point_mass": PointMassConfig,
    "windows": Annotated[list[PositiveInt], Field(min_length=2)],
    "looks": Annotated[list[Budget], Field(min_length=1)],
    "sgd_rates": Annotated[list[PositiveFloat], Field(min_length=2)],
    "grids": Annotated[list[Annotated[list[PositiveFloat], Field(min_length=2)]], Field(min_length=1)],
    "scores": Annotated[list[Literal["sum", "mean"]], Field(min_length=1)],
    "budgets": Annotated[list[Budget], Field(min_length=1)],
    "resamples": Annotated[int, Field(ge=2)],
    "navigator": NavigatorConfig,
    "rollout": RolloutConfig,
    "pretraining": PretrainingConfig,
    "oracle_seeds": PositiveInt,
    "configurations": Annotated[list[Configuration], Field(min_length=1)],
    "sigmas": Annotated[list[PositiveFloat], Field(min_length=1)],
    "taus": Annotated[list[NonNegativeFloat], Field(min_length=1)],
    "draws": PositiveInt,
    "stretch": Stretch,
    "seeds": dict[str, PositiveInt],
    "more_seeds": PositiveInt,
    "minibatches": Annotated[list[PositiveInt], Field(min_length=2)],
    "tried_seeds": dict[str, PositiveInt],
    "latent_heads": PositiveInt,
    "episodes": PositiveInt,
    "matched": MatchedEncoderConfig,
    "cheap": MatchedEncoderConfig,
    "checks": MatchedGateConfig,
    "sessions": SessionsConfig,
    "sweep": dict[Literal["hazard", "clear", "shots"], PositiveInt],
    "rails": RailsConfig,
    "lengths": Annotated[list[PositiveInt], Field(min_length=1)],
    "encoder_seeds": Annotated[int, Field(ge=2)],
    "simulated": Annotated[int, Field(ge=2)],
    "effects": Annotated[list[str], Field(min_length=1)],
    "device": Literal["auto", "cpu", "cuda"],
    "controls": ControlsConfig,
    "corridors": Annotated[list[Literal[2, 3, 4, 6]], Field(min_length=2), _with([4])],  # of beyond.corridors.ARENAS
    "slabs": Annotated[list[Literal["one", "two", "any"]], _with(["one", "any"])],  # of beyond.corridors.ARENAS
    "early": PositiveInt,
    "message_seeds": dict[str, PositiveInt],
    "broadcast": PixelsConfig,
    "decider": DeciderSizes,
    "moving": MovingSizes,
    "errand_shares": Annotated[list[Share], Field(min_length=2)],
    "watchings": Annotated[list[Share], Field(min_length=2)],
    "commit_steps": Annotated[list[PositiveInt], Field(min_length=2)],
    "scout_counts": Annotated[list[PositiveInt], Field(min_length=2)],
    "rungs": Annotated[list[Rung], Field(min_length=1)],
    "radio": DeciderSizes,
    "widths": Annotated[list[Bits], _with([1, 4])],
    "directions": Annotated[list[Directions], _with([64])],
    "qualities": Annotated[list[Quality], Field(min_length=1)],
    "losses": Annotated[list[Chance], _with([0.7])],
    "memory": Chance,
    "patience": PositiveInt,
    "latencies": Annotated[list[NonNegativeInt], Field(min_length=2)],
    "decibels": Annotated[list[float], _with([0.0])],
    "reaches": Annotated[list[PositiveFloat], Field(min_length=1)],
    "crowds": Annotated[list[PositiveInt], _with([1, 2, 4])],
    "loop": LoopSizes,
    "readers": DeciderSizes,
    "candidate": str,
    "driving_study": PixelsConfig,
}
