"""Settings arrive: what a profile says reaches every run that reads it, or the profile is refused in one line."""

import ast

import numpy as np
import pytest

from lt_lib.gridworld.protocol import GridProtocol
from lt_lib.hardware.protocol import HardwareProtocol
from lt_lib.hardware.registration import read_gates
from lt_lib.perception.gates import GateError
from lt_lib.pixels.crew import TRIAL
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.pixels.redraw import SCENES
from lt_lib.settings.base import ROOT, Scene, Settings, UserError
from lt_lib.settings.gridworld import GridworldConfig
from lt_lib.settings.hardware import MatchedEncoderConfig, SessionsConfig
from lt_lib.settings.pixels import PixelsConfig
from lt_lib.settings.profiles import load_profile, notebook_names, validated
from lt_lib.settings.velocity import NavigatorConfig, RolloutConfig
from lt_lib.store.runs import RunStore
from lt_lib.velocity.transfer import DirectTransfer
from run_all import code_cells

PROFILES = ("full", "quick")
# what the velocity study reads of a navigator's training and of its episodes
PLAYED = {
    "episodes": np.zeros((0, 4), int), "sigma": np.ones((0, 3)), "boost": np.ones(0),
    "first": np.zeros((2, 4), int), "slab": np.tile([0, 1], (2, 2)),
}  # fmt: skip
OTHER = {"layout": "wide", "latency": 3}  # neither is a default


class Recorder(RunStore):
    """A run store that computes nothing and remembers what it was asked for."""

    def __init__(self, **result):
        super().__init__(ROOT)
        self.__dict__.update(runs=[], result=result)  # a store is frozen

    def fetch(self, runs, what):
        self.runs.extend(runs)
        return [dict(self.result) for _ in runs]

    def configs(self, function: str) -> list[Settings]:
        found = [run.config for run in self.runs if run.function.__name__ == function]
        assert found, f"no run of {function}"
        return found


PASSED = {"hazard": 1.0, "majority": 0.5, "walls": 1.0, "rank": 64.0}  # an encoder's gates, and an executor's trial
PASSED |= {"success": np.ones((1, 2, 2), bool), "entered": np.array([[[0, 1]] * 2]), "contacts": np.ones((1, 2, 2))}


def with_store(protocol, store):
    object.__setattr__(protocol, "store", store)
    return protocol


def pixel_runs(pixels: dict, seeds: dict, layout: str) -> tuple[PixelProtocol, Recorder]:
    """Every run that notebooks 02, 04 and 07 ask for."""
    store = Recorder(**PASSED)
    protocol = with_store(PixelProtocol.of(pixels, layout, "cpu", 0), store)
    protocol.gate_reports(protocol.encoders())
    protocol.executor_weights({})
    protocol.episode_bank({}, {})
    protocol.trained_heads(seeds, {}, {})
    protocol.redrawn_heads(seeds, dict.fromkeys(SCENES, 0), {}, {})
    protocol.corrupted("latent", 0, {}, 7, {}, {})
    protocol.without_anchor(1, {}, {})
    return protocol, store


def assert_arrives(given: dict, configs: list[Settings], section: str) -> None:
    """Some run has all that a section says, since others vary one thing on purpose."""
    kind = type(configs[0])
    wanted = {name: getattr(kind(**given), name) for name in given} if section != "evaluation" else given
    assert any(all(getattr(config, name) == value for name, value in wanted.items()) for config in configs), section


STAGES = {
    "encoder": "train_encoder", "probe": "measure_gates", "executor": "train_executor", "bank": "roll_bank",
    "head": "train_head", "redraw": "train_redrawn_head",
}  # fmt: skip


@pytest.mark.parametrize("profile", PROFILES)
def test_every_pixel_setting_of_a_profile_reaches_its_runs(profile):
    given = load_profile(profile)["04_pixels"]
    pixels = given["pixel_study"] | {"latency": OTHER["latency"]}
    protocol, store = pixel_runs(pixels, given["seeds"], OTHER["layout"])
    for section, function in STAGES.items():
        assert_arrives(pixels[section], store.configs(function), section)
    assert {name: getattr(protocol.sizes.gates, name) for name in pixels["gates"]} == pixels["gates"]
    shards = [run for run in store.runs if run.function.__name__ == "roll_bank" and run.seed != TRIAL]
    assert len(shards) == pixels["shards"]
    assert set(pixels) == {*STAGES, "gates", "shards", "latency"}  # nothing else is left to check
    assert_shared_everywhere(store)


def assert_shared_everywhere(store: Recorder) -> None:
    for run in store.runs:
        for name, value in OTHER.items():
            assert getattr(run.config, name, value) == value, f"{run.function.__name__} has another {name}"


@pytest.mark.parametrize("name", ["encoder", "probe", "executor", "bank", "head", "redraw"])
def test_a_value_that_is_nobody_s_default_reaches_the_runs(name):
    """Every field of every section, so that one which is accepted and then dropped is found."""
    kind = PixelsConfig.model_fields[name].annotation
    for field, info in kind.model_fields.items():
        if field in kind.decided or not isinstance(info.default, int | float) or isinstance(info.default, bool):
            continue
        value = info.default / 2 if isinstance(info.default, float) else info.default + 1
        _, store = pixel_runs({name: {field: value}}, {"latent": 1, "k1": 1}, "default")
        configs = store.configs(STAGES[name])
        assert any(getattr(config, field) == value for config in configs), f"{name}.{field}"


@pytest.mark.parametrize("profile", PROFILES)
def test_every_gridworld_setting_of_a_profile_reaches_its_runs(profile):
    given = load_profile(profile)["03_gridworld"]
    gridworld, store = given["gridworld"] | {"layout": "grid_peek", "latency": 3}, Recorder()
    protocol = with_store(GridProtocol.of(gridworld, 0), store)
    protocol.gate_reports(protocol.encoders())
    encoder = {"mean": np.full(64, 5.0), "std": np.full(64, 2.0)}
    protocol.corrupted(protocol.trained(gridworld["seeds"], encoder), 7, encoder)
    entered = GridProtocol.of(gridworld | {"scaled": "none"}, 0).frozen(encoder)  # the form that is not the default
    assert protocol.scaled == gridworld.get("scaled", "each") and entered["mean"].max() == 0
    assert_arrives(gridworld["encoder"], store.configs("train_patch_encoder"), "encoder")
    assert_arrives(gridworld["policy"], store.configs("train_grid"), "policy")
    assert {name: getattr(protocol.gates, name) for name in gridworld["gates"]} == gridworld["gates"]
    for run in store.runs:
        assert run.config.layout == "grid_peek"
        assert getattr(run.config, "latency", 3) == 3


@pytest.mark.parametrize("profile", PROFILES)
def test_every_velocity_setting_of_a_profile_reaches_its_runs(profile):
    given, store = load_profile(profile)["05_coverage_sweep"], Recorder(**PLAYED)
    pixels = PixelProtocol.of({"latency": 3}, "wide", "cpu", 0)
    object.__setattr__(pixels, "encoder_weights", dict)
    sections = (given[name] for name in ("navigator", "rollout", "pretraining"))
    study, asked = with_store(DirectTransfer.of(pixels, *sections), store), given["pretraining"]
    pretrained, told = study.pretrained(), study.told(given["oracle_seeds"])
    study.examined(study.navigators(given["configurations"], pretrained, told["oracle"]))
    study.grown(pretrained)
    assert_arrives(given["navigator"], store.configs("train_navigator"), "navigator")
    assert_arrives(given["rollout"], store.configs("roll_navigator"), "rollout")
    assert any(config.episodes == asked["episodes"] for config in store.configs("roll_navigator"))
    assert any(config.looks == tuple(asked["looks"]) for config in store.configs("train_navigator"))
    assert {*asked["bit_looks"]} <= {*study.bit_looks}
    assert all(len(seeds) == asked["seeds"] for seeds in pretrained.values())
    assert len(study.at_looks(pretrained[asked["curriculum"]])) == len(asked["looks"])
    assert_shared_everywhere(store)
    study.boosted([{}])
    lengths = {config.steps for config in store.configs("train_navigator") if config.boost.first > 1}
    assert lengths == {study.pretraining.boosted * study.navigator.envs * study.navigator.rollout}


@pytest.mark.parametrize("profile", PROFILES)
def test_every_hardware_setting_of_a_profile_reaches_its_runs(profile):
    given, store = load_profile(profile)["08_hardware_decode"], Recorder()
    sections = {name: given[name] for name in ("matched", "cheap", "checks", "sessions", "executor", "rails")}
    gates = read_gates(ROOT / given["gate_file"])
    protocol = with_store(HardwareProtocol.of(gates, 0, "cpu", "", given["simulated"], **sections), store)
    protocol.gate_reports(protocol.encoders())
    protocol._films()
    protocol.after_selection(next(iter(gates.candidates)), {}, given["encoder_seeds"], given["lengths"])
    protocol.sweeps(given["effects"], given["sweep"])
    assert_arrives(given["matched"], store.configs("train_matched_encoder"), "matched")
    assert_arrives(given["cheap"], store.configs("train_matched_encoder"), "cheap")
    assert_arrives(given["checks"], store.configs("measure_matched_gates"), "checks")
    driving = given["executor"] | {"steps": max(given["lengths"])}  # kept at `executor.steps` on its way
    assert_arrives(driving, store.configs("train_executor"), "executor")
    assert store.configs("train_executor")[0].looks == tuple(given["lengths"])
    with pytest.raises(UserError, match="lengths: expected multiples of 8192 control steps"):
        protocol.after_selection(next(iter(gates.candidates)), {}, 1, [8192])
    assert_arrives(given["sweep"] | {"effect": given["effects"][0]}, store.configs("film_sweep"), "sweep")
    for session in given["sessions"].values():
        assert_arrives(session, store.configs("film_session"), "sessions")
    assert len(store.configs("train_matched_encoder")) == len(gates.candidates) + 1 + given["encoder_seeds"]
    assert protocol.rails.rollouts == given["rails"]["rollouts"]


@pytest.mark.parametrize(
    ("kind", "name", "value", "place"),
    [
        (PixelsConfig, "pixel_study", {"head": {"content": "position"}}, "pixel_study.head.content"),
        (PixelsConfig, "pixel_study", {"head": {"latency": 2}}, "pixel_study.head.latency"),
        (PixelsConfig, "pixel_study", {"redraw": {"every": 5}}, "pixel_study.redraw.every"),
        (PixelsConfig, "pixel_study", {"encoder": {"layout": "wide"}}, "pixel_study.encoder.layout"),
        (PixelsConfig, "pixel_study", {"bank": {"device": "cpu"}}, "pixel_study.bank.device"),
        (GridworldConfig, "gridworld", {"policy": {"content": "raw"}, "seeds": {}}, "gridworld.policy.content"),
        (NavigatorConfig, "navigator", {"boost": {"first": 2.0}}, "navigator.boost"),
        (RolloutConfig, "rollout", {"start": "left"}, "rollout.start"),
        (MatchedEncoderConfig, "matched", {"colour": 0.5}, "matched.colour"),
        (SessionsConfig, "sessions", {"live": {"layout": "wide"}}, "sessions.live.layout"),
    ],
)
def test_what_a_study_decides_run_by_run_is_refused_in_a_profile(kind, name, value, place):
    with pytest.raises(UserError, match=f"^{place}: the study sets this for each run; leave it out$"):
        validated(kind, name, value)


@pytest.mark.parametrize("bank", [{"entries": 3}, {"entries": 256, "held_out": 0.0}, {"entries": 8, "held_out": 1.0}])
def test_a_bank_without_a_draw_to_train_or_to_evaluate_on_is_refused_in_one_line(bank):
    with pytest.raises(UserError, match=r"^pixel_study: .*a bank of 2 x \d+ draws .* leaves none"):
        validated(PixelsConfig, "pixel_study", {"bank": bank, "shards": 2})


def test_every_setting_is_read_somewhere():
    """By its name, as an attribute or as text, above the settings: in the library or in a notebook."""
    above = [path for path in (ROOT / "lt_lib").rglob("*.py") if path.parent.name != "settings"]
    code = [path.read_text(encoding="utf-8") for path in above]
    code += [cell for name in notebook_names() for cell in code_cells(ROOT, name) if '# "" means' not in cell]
    read: set[str] = set()
    for node in (node for text in code for node in ast.walk(ast.parse(text))):
        if isinstance(node, ast.Attribute | ast.keyword | ast.Constant):
            read.add(getattr(node, "attr", getattr(node, "arg", getattr(node, "value", None))))
    kinds, todo = [], [Settings]
    while todo:
        kinds += (below := [kind for kind in todo.pop().__subclasses__() if kind.__module__.startswith("lt_lib.")])
        todo += below
    assert len(kinds) > 25
    unread = {f"{kind.__name__}.{name}" for kind in kinds if kind is not Scene for name in kind.model_fields} - {
        f"{kind.__name__}.{name}" for kind in kinds for name in kind.model_fields if name in read
    }
    assert not unread


@pytest.mark.parametrize(("walls", "tried"), [((0.96, 0.99), 1), ((0.94, 0.96), 2), ((0.9, 0.94, 0.94), 3)])
def test_encoders_are_tried_seed_after_seed_until_one_passes_its_gates(walls, tried):
    class Gated(Recorder):
        def fetch(self, runs, what):
            super().fetch(runs, what)
            gate = [walls[run.inputs["encoder"]["seed"]] if run.inputs else None for run in runs]
            return [
                PASSED | {"walls": value} if value else {"seed": run.seed}
                for run, value in zip(runs, gate, strict=True)
            ]

    study = {"gates": {"walls": 0.95}}
    protocol = with_store(PixelProtocol.of(study, "default", "cpu", 0), Gated())
    found = protocol.tried_encoders()
    assert [encoder["seed"] for encoder, _ in found] == list(range(tried))
    assert protocol.encoders()["ours"] == found[-1][0]
    if max(walls) >= 0.95:
        assert protocol.encoder_weights() == found[-1][0]
    else:
        with pytest.raises(GateError, match="wall-count R.2 0.940 is 0.010 short"):
            protocol.encoder_weights()
