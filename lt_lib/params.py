"""Validated settings: the base of every configuration, and the profiles run_all.py gives to notebooks."""

import ast
import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    TypeAdapter,
    ValidationError,
    computed_field,
    model_validator,
)

ROOT = Path(__file__).resolve().parents[1]


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

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, values: Any) -> Any:
        if isinstance(values, dict):
            return {name: _frozen(value) for name, value in values.items()}
        return values


def profile_names(root: Path = ROOT) -> list[str]:
    """The profiles of a project: every yaml file in params/ but the paper's claims."""
    return sorted(path.stem for path in (root / "params").glob("*.yaml") if path.stem != "claims")


def notebook_names(root: Path = ROOT) -> list[str]:
    """The notebooks of a project in numeric order, e.g. '04_pixels'."""
    return sorted(path.stem for path in (root / "notebooks").glob("[0-9][0-9]_*.ipynb"))


def notebook_defaults(path: Path) -> dict[str, Any]:
    """The names and literal values assigned in the one cell of a notebook that is tagged 'parameters'."""
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
    """What a profile gives to each notebook: {notebook: {parameter: value}}, everything checked.

    A notebook's own section goes over `shared`, whose keys reach every notebook that declares them. A value
    replaces the notebook's default as a whole, dicts included.

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


class _UniqueKeys(yaml.SafeLoader):
    """yaml as it is meant: a key given twice is an error, not the last one's win."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        for key, count in Counter(self.construct_object(key) for key, _ in node.value).items():
            if count > 1:
                raise yaml.MarkedYAMLError(problem=f"{key!r} is given twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def _read_sections(path: Path, defaults: Mapping[str, Mapping]) -> dict[str, dict[str, Any]]:
    """The sections of a profile's file, once every notebook and every shared parameter in it is known."""
    try:
        sections = yaml.load(path.read_text(encoding="utf-8"), _UniqueKeys) or {}
    except yaml.YAMLError as error:
        raise UserError(f"{path.name}: not valid yaml: {' '.join(str(error).split())}") from None
    if not isinstance(sections, dict):
        raise UserError(f"{path.name}: expected sections such as 'shared:', got {sections!r}")
    for section, values in sections.items():
        if section != "shared":
            require_known([section], defaults, "notebook", f"{path.name}: ")
        if not isinstance(values, dict):
            raise UserError(f"{path.name}: {section}: expected its parameters below it, got {values!r}")
    declared = {key for names in defaults.values() for key in names}
    for key in sections.get("shared", {}):
        if key not in declared:
            known = _listed(declared)
            raise UserError(f"{path.name}: shared: no notebook declares {key!r}; there are {known}")
    return sections


def _check_value(where: str, key: str, value: Any, declared: Mapping[str, Any]) -> None:
    """A parameter must be declared by its notebook, have the type of its default, and satisfy SECTIONS."""
    if key not in declared:
        raise UserError(f"{where}: unknown parameter {key!r}; there are {_listed(declared)}")
    if not _same_type(value, declared[key]):
        expected = type(declared[key]).__name__
        raise UserError(f"{where}: {key}: expected {expected} such as {declared[key]!r}, got {value!r}")
    if key in SECTIONS:
        try:
            TypeAdapter(SECTIONS[key]).validate_python(value, strict=True)
        except ValidationError as error:
            raise UserError(f"{where}: {explain(error, key, SECTIONS[key])}") from None
    elif isinstance(value, dict):
        raise UserError(f"{where}: {key}: SECTIONS has no settings for it; there are {_listed(SECTIONS)}")


def _same_type(value: Any, default: Any) -> bool:
    """Whether a value may stand for a default: the same type, int for float, lists item by item."""
    if isinstance(default, list) and isinstance(value, list) and default:
        return all(any(_same_type(item, example) for example in default) for item in value)
    return type(value) is type(default) or (type(default) is float and type(value) is int)


def explain(error: ValidationError, name: str, settings: Any) -> str:
    """The first complaint of pydantic in one line, e.g. 'encoder.frames: must be greater than 0, got -1'."""
    first = error.errors()[0]
    place = ".".join([name, *map(str, first["loc"])])
    if first["type"] == "extra_forbidden":
        for part in first["loc"][:-1]:
            settings, name = _inside(settings, part), f"{name}.{part}"
        return f"{place}: unknown parameter; {name} has {_listed(settings.model_fields)}"
    complaint = first["msg"].replace("Input should be", "must be")
    return f"{place}: {complaint}, got {first['input']!r}"


def _inside(settings: Any, part: str | int) -> Any:
    """The type of what settings have under a name, or of the items of a list or dict of settings."""
    if hasattr(settings, "model_fields"):
        return settings.model_fields[part].annotation
    return next(kind for kind in reversed(get_args(settings)) if kind is not ...)


def _listed(names: Any) -> str:
    return ", ".join(sorted(names))


# --- settings
LAYOUTS = ROOT / "params" / "layouts"


def layout_path(name: str) -> Path:
    """The file of a layout: params/layouts/<name>.yaml, or a path to a yaml file of one's own.

    Raises UserError for an unknown name.
    """
    path = Path(name) if name.endswith(".yaml") else LAYOUTS / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in LAYOUTS.glob("*.yaml")))
        raise UserError(f"unknown layout '{name}'; known: {known}, or the path of a .yaml file")
    return path


Share = Annotated[float, Field(ge=0, le=1)]
Precision = Literal["float32", "bfloat16"]
# The six direct transfers to velocity control, by what each varies (learners/transfer.py)
Configuration = Literal[
    "base", "no hazard penalty", "hazard penalty x 5", "discount 0.995", "more spawn curriculum", "wide layout",
]  # fmt: skip


class Training(Settings):
    """What every training shares: the scene, and the device that computes it."""

    layout: str = "default"
    device: Literal["cpu", "cuda"] = "cpu"

    @computed_field
    @property
    def layout_digest(self) -> str:
        """sha256 of the layout's file, so that an edited scene is another setting."""
        return hashlib.sha256(layout_path(self.layout).read_bytes()).hexdigest()


class EncoderConfig(Training):
    """Stage 1 (Section Implementation); loss weights are ours, see ASSUMPTIONS.md."""

    frames: PositiveInt = 204_800
    rollout: Annotated[int, Field(ge=2)] = 32  # frames a rollout
    epochs: NonNegativeFloat = 2.5
    batch: Annotated[int, Field(ge=2)] = 256
    lr: PositiveFloat = 1e-3
    ema: Annotated[float, Field(ge=0, lt=1)] = 0.99
    prediction: NonNegativeFloat = 1.0
    variance: NonNegativeFloat = 25.0
    covariance: NonNegativeFloat = 2.5
    reconstruction: NonNegativeFloat = 1.0


class GateConfig(Training):
    """How the freeze gates are measured: held-out rollouts, and how many latents to show."""

    rollouts: Annotated[int, Field(ge=10)] = 640
    length: PositiveInt = 32
    shown: PositiveInt = 4_000


class Gates(Settings):
    """The pre-registered thresholds; the defaults are the paper's measured hazard probe and ours for the rest."""

    hazard: Share = 0.935
    walls: Annotated[float, Field(le=1)] = 0.95
    rank: NonNegativeFloat = 40.0


class PpoConfig(Settings):
    """The settings that every policy, seed and condition shares (Section Implementation)."""

    clip: PositiveFloat = 0.2
    epochs: PositiveInt = 4
    entropy: NonNegativeFloat = 0.01
    gamma: Share = 0.99
    lam: Share = 0.95


class ExecutorConfig(Training):
    """The low-level controller's pretraining (Section Implementation)."""

    steps: PositiveInt = 1_000_000
    envs: PositiveInt = 64
    rollout: PositiveInt = 128  # control steps an environment and update
    minibatch: PositiveInt = 256
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"


class BankConfig(Training):
    """One shard of the episode bank: the frozen executor on every (draw of the scene, slab, route)."""

    entries: PositiveInt = 256  # draws of spawn and scout pose
    envs: PositiveInt = 64
    commit_step: NonNegativeInt = 2
    precision: Precision = "float32"


class HeadConfig(Training):
    """Stage 2: the route head, trained from episode reward alone (Section Implementation)."""

    content: str = "latent"  # a name in comm.messages.CONTENTS
    wire: str = "intact"  # a name in comm.channel.CORRUPTIONS
    held_out: Share = 0.125  # of the bank's draws, kept for evaluation
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256
    minibatch: PositiveInt = 64
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()


class EvaluationConfig(Training):
    """One cell of Table IV: a frozen head under one wire condition."""

    content: str
    wire: str
    held_out: Share = 0.125
    episodes: PositiveInt = 256


class RedrawConfig(Training):
    """The route head trained live, its route drawn anew every so many control steps (lower block of Table III)."""

    content: str = "latent"  # a name in comm.messages.CONTENTS
    every: NonNegativeInt = 0  # control steps between draws, the paper's k; 0: one draw an episode
    credit: str = "episode"  # a name in learners.redraw.CREDITS
    held_out: Share = 0.125  # of the bank's draws, as for the heads that train on the bank
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256  # episodes
    minibatch: PositiveInt = 64  # episodes' worth of draws
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()
    envs: PositiveInt = 64
    commit_step: NonNegativeInt = 2
    precision: Precision = "float32"


class PatchEncoderConfig(EncoderConfig):
    """Stage 1 in the gridworld, which has about a hundred views where the pixels have any number."""

    layout: str = "grid"
    variance: NonNegativeFloat = 1.0
    covariance: NonNegativeFloat = 0.1


class PatchGateConfig(Training):
    """How the gridworld's freeze gates are measured: cross-validation over cells, so many folds."""

    layout: str = "grid"
    folds: Annotated[int, Field(ge=2)] = 10


class PatchGates(Settings):
    """The gridworld's pre-registered thresholds."""

    hazard: Share = 0.9
    share: Share = 0.12
    rank: NonNegativeFloat = 20.0


class GridConfig(Training):
    """The gridworld's receiver, trained by MAPPO (Sections Implementation, Gridworld)."""

    layout: str = "grid"
    content: str = "latent"  # a name in comm.grid_wires.GRID_CONTENTS
    steps: PositiveInt = 1_200_000
    envs: PositiveInt = 64
    rollout: PositiveInt = 512  # steps an environment and update
    minibatch: PositiveInt = 1_024
    lr: PositiveFloat = 1e-3
    ppo: PpoConfig = PpoConfig()


class GridEvaluationConfig(Training):
    """A frozen policy of the gridworld under one wire condition."""

    layout: str = "grid"
    content: str
    wire: str  # a name in comm.channel.CORRUPTIONS
    episodes: PositiveInt = 256


class GridworldConfig(Settings):
    """All that the gridworld's protocol needs, in one parameter; every stage takes the section's layout."""

    layout: str = "grid"
    encoder: PatchEncoderConfig = PatchEncoderConfig()
    gates: PatchGates = PatchGates()
    policy: GridConfig = GridConfig()
    seeds: dict[str, PositiveInt]  # how many of each content


BLOCK = 25  # updates of the point-mass study between two looks at it
Budget = Annotated[int, Field(gt=0, multiple_of=BLOCK)]


class PointMassConfig(Settings):
    """One stack of the point-mass study: every d with every sigma at one window length (Section Scalar predictor)."""

    arm: Literal["gaussian", "no_signal", "categorical", "unclamped"] = "gaussian"
    window: PositiveInt = 30  # control steps N
    distances: tuple[PositiveFloat, ...] = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.1, 1.3)
    sigmas: tuple[PositiveFloat, ...] = (0.55, 1.0)
    seeds: PositiveInt = 5
    optimiser: Literal["adam", "sgd"] = "adam"
    baseline: Literal["batch", "message"] = "batch"  # mean reward of the batch, or of its episodes with this message
    lr: PositiveFloat = 0.02
    batch: Annotated[int, Field(ge=2)] = 128  # episodes an update
    budgets: Annotated[tuple[Budget, ...], Field(min_length=1)] = (
        1_000,
    )  # updates after which success is measured, in order; the last one ends the training
    evaluation: PositiveInt = 8_192  # episodes of a measurement

    @model_validator(mode="after")
    def _budgets_in_order(self) -> "PointMassConfig":
        if list(self.budgets) != sorted(set(self.budgets)):
            raise ValueError(f"budgets must increase, got {list(self.budgets)}")
        return self


class Boost(Settings):
    """Extra lateral noise in an episode's first steps (Section Effect of increased exploration noise); 1 is none."""

    first: Annotated[float, Field(ge=1)] = 1.0  # times the policy's own noise, before the first iteration
    last: Annotated[float, Field(ge=1)] = 1.0  # at iteration `at`
    at: PositiveInt = 80
    window: NonNegativeInt = 40  # control steps
    tau: NonNegativeFloat = 30.0  # control steps, AR(1)


class NavigatorConfig(Training):
    """A navigator without a route: PPO from the team's reward (Section From Grid Actions to Velocity Commands)."""

    content: str = "floor"  # a name in comm.messages.CONTENTS
    blocked: Literal["random", "left", "right"] = "random"  # the slab's corridor; a fixed one leaves no choice
    hazard: NonNegativeFloat = 1.0  # penalty of reaching the slab
    starts: Literal["anywhere", "beyond"] = "beyond"  # the curriculum's: the free arena, or past the mouths alone
    spawn_share: Share = 0.5  # episodes that start at the spawn whatever the curriculum says
    boost: Boost = Boost()
    steps: PositiveInt = 655_360  # 80 updates
    envs: PositiveInt = 128
    rollout: PositiveInt = 64  # control steps an environment and update
    minibatch: PositiveInt = 512
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"


class Exploration(Settings):
    """One row of Table II: lateral AR(1) noise imposed on the first `window` steps of an episode."""

    sigma: NonNegativeFloat = 0.0  # stationary standard deviation, of a command in [-1, 1]
    tau: NonNegativeFloat = 0.0  # correlation time, control steps; 0 is iid
    window: NonNegativeInt = 600  # control steps; after it the lateral noise is the policy's own
    own: NonNegativeFloat = 1.0  # factor on the policy's own noise, elsewhere; 0 is deterministic


class RolloutConfig(Training):
    """Episodes of a frozen navigator, no learning."""

    content: str = "floor"
    start: Literal["spawn", "left", "right"] = "spawn"  # or in front of a corridor's mouth
    blocked: Literal["random", "left", "right"] = "random"
    truthful: bool = True  # whether an oracle's message is true or flipped
    rows: Annotated[tuple[Exploration, ...], Field(min_length=1)] = (Exploration(),)
    episodes: PositiveInt = 128  # a row
    paths: NonNegativeInt = 24  # episodes a row whose path is kept
    horizon: PositiveInt = 600  # control steps
    precision: Precision = "float32"


Sizes = Annotated[tuple[PositiveInt, ...], Field(min_length=3)]  # that a slope is fitted through


class Stretch(Settings):
    """How much of the real work notebook 10 times, and at which sizes."""

    rounds: PositiveInt  # in which all sides take turns
    scenes: PositiveInt  # draws of the scene behind either precision
    live: PositiveInt  # episodes
    navigator: PositiveInt  # control steps of a navigator's training, profiled
    frames: PositiveInt  # of a matched encoder's training, profiled
    singles: PositiveInt  # runs of a stack timed one by one
    runs: PositiveInt  # shared among workers
    updates: Budget  # of the point-mass study
    environments: Sizes
    seeds: Sizes
    episodes: Sizes


class MatchedEncoderConfig(EncoderConfig):
    """Stage 1 at the camera's optics, floor and walls recoloured in every rollout (Section Hardware)."""

    layout: str = "matched"
    frames: PositiveInt = 102_400
    colour: Share = 1.0  # of a material's own colour that a random one replaces; 0 leaves the simulation's
    texture: NonNegativeFloat = 0.0  # standard deviation of the blotches on floor and walls, as a share of their colour


class MatchedGateConfig(Training):
    """How a candidate's gates are measured: held-out rollouts, one appearance range for all candidates."""

    layout: str = "matched"
    rollouts: Annotated[int, Field(ge=10)] = 480
    length: PositiveInt = 32
    colour: Share = 1.0
    texture: NonNegativeFloat = 0.1


class OpticsConfig(Settings):
    """The surrogate camera from lens to file; every field is an effect, its strength and its unit."""

    distortion: NonNegativeFloat = 0.1  # k: what is seen at radius r (focal lengths) lies at r (1 + k r^2); a barrel
    vignetting: Share = 0.3  # share of the light lost in the frame's corner
    blur: NonNegativeFloat = 1.5  # pixels that the picture moves during an exposure, in a random direction
    exposure: NonNegativeFloat = 0.25  # stops, standard deviation of the drift from frame to frame
    balance: NonNegativeFloat = 0.08  # standard deviation of the log gain of red and of blue
    full_well: PositiveFloat = 4_000.0  # electrons at white: shot noise
    read_noise: NonNegativeFloat = 6.0  # electrons rms
    mosaic: bool = True  # one colour a pixel, the others interpolated (Bayer)
    jpeg: Annotated[int, Field(ge=1, le=100)] = 80  # quality


class BenchConfig(Settings):
    """How the robot stands in front of a corridor, and what else is there."""

    turn: Annotated[float, Field(gt=0, lt=90)] = 18.0  # degrees off the centre line, towards the corridor in question
    position: NonNegativeFloat = 3.0  # cm, +- of the robot's place by hand
    heading: NonNegativeFloat = 2.0  # degrees, +- of its heading by hand
    clutter: Annotated[int, Field(ge=0, le=12)] = 4  # objects on the floor
    dim: NonNegativeFloat = 1.0  # stops by which the dim state's light is turned down, besides a lamp that is off


class SessionConfig(Training):
    """One session: so many placements, a few frames of each."""

    layout: str = "matched"
    hazard: PositiveInt = 19  # placements with the slab in the corridor in question
    clear: PositiveInt = 15  # placements with the slab in the other one
    shots: PositiveInt = 3  # frames a placement
    frames: NonNegativeInt = 0  # the session ends after so many; 0: after the last placement
    near: PositiveFloat = 120.0  # cm from the camera to the slab's front
    far: PositiveFloat = 250.0  # cm
    marks: NonNegativeInt = 0  # distances, evenly from near to far; 0: anywhere between
    lighting: tuple[Literal["bright", "dim"], ...] = ("bright", "dim")  # taken in turn
    bench: BenchConfig = BenchConfig()
    optics: OpticsConfig = OpticsConfig()

    @model_validator(mode="after")
    def _near_is_nearer(self) -> "SessionConfig":
        if not self.near < self.far:
            raise ValueError(f"near must be below far, got {self.near} and {self.far} cm")
        return self


class SessionsConfig(Settings):
    """The sessions with the camera (Section Hardware): refit, quarantined validation, live."""

    refit: SessionConfig = SessionConfig(hazard=9, clear=9, frames=53, far=240.0, marks=5, lighting=("bright",))
    validation: SessionConfig = SessionConfig(hazard=7, clear=7, near=135.0, far=225.0, marks=4, lighting=("dim",))
    live: SessionConfig = SessionConfig()


class SweepConfig(SessionConfig):
    """One effect at rising strengths, everything else as in `SessionConfig`; the placements are the same at each."""

    effect: str  # a name in perception.sessions.EFFECTS
    hazard: PositiveInt = 10
    clear: PositiveInt = 10
    shots: PositiveInt = 2


class RailsConfig(Training):
    """How bang-bang an executor is: on frames of held-out rollouts, under both routes."""

    layout: str = "matched"
    rollouts: PositiveInt = 64
    length: PositiveInt = 32


class HardwareGates(Settings):
    """params/gates/hardware.yaml, whose head explains it; fixed before any camera frame was looked at."""

    candidates: Annotated[dict[str, dict[Literal["colour", "texture"], Share]], Field(min_length=1)]
    hazard: Share
    walls: Annotated[float, Field(le=1)]  # R^2
    rank: NonNegativeFloat
    decode: Share
    red_ratio: PositiveFloat
    red_share: Share


# How the profiles' and notebooks' parameters of these names are checked: settings by their class, others by type.
SECTIONS: dict[str, Any] = {
    "encoder": EncoderConfig,
    "probe": GateConfig,
    "gates": Gates,
    "executor": ExecutorConfig,
    "bank": BankConfig,
    "head": HeadConfig,
    "redraw": RedrawConfig,
    "gridworld": GridworldConfig,
    "peek_seeds": dict[str, PositiveInt],
    "ablation_seeds": PositiveInt,
    "point_mass": PointMassConfig,
    "windows": Annotated[list[PositiveInt], Field(min_length=2)],
    "looks": Annotated[list[Budget], Field(min_length=1)],
    "sgd_rates": Annotated[list[PositiveFloat], Field(min_length=2)],
    "resamples": Annotated[int, Field(ge=2)],
    "singles": PositiveInt,
    "timed_updates": Budget,
    "navigator": NavigatorConfig,
    "rollout": RolloutConfig,
    "oracle_seeds": PositiveInt,
    "configurations": Annotated[list[Configuration], Field(min_length=1)],
    "sigmas": Annotated[list[PositiveFloat], Field(min_length=1)],
    "taus": Annotated[list[NonNegativeFloat], Field(min_length=1)],
    "draws": PositiveInt,
    "stretch": Stretch,
    "seeds": dict[str, PositiveInt],
    "shards": PositiveInt,
    "more_seeds": PositiveInt,
    "latent_heads": PositiveInt,
    "episodes": PositiveInt,
    "matched": MatchedEncoderConfig,
    "cheap": MatchedEncoderConfig,
    "checks": MatchedGateConfig,
    "sessions": SessionsConfig,
    "sweep": dict[Literal["hazard", "clear", "shots"], PositiveInt],
    "rails": RailsConfig,
    "encoder_seeds": Annotated[int, Field(ge=2)],
    "simulated": Annotated[int, Field(ge=2)],
    "effects": Annotated[list[str], Field(min_length=1)],
    "device": Literal["auto", "cpu", "cuda"],
}
