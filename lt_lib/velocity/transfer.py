"""Direct transfer to velocity control: the runs of the study (Section From Grid Actions to Velocity Commands).

Notebook 5 fetches them from here. All navigators share one set of settings and differ only in what their names say.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lt_lib.envs.layout import SIDES
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.settings.base import UserError, everywhere
from lt_lib.settings.ppo import PpoConfig
from lt_lib.settings.profiles import validated
from lt_lib.settings.velocity import Boost, Exploration, NavigatorConfig, PretrainingConfig, RolloutConfig
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore, fetch_by_name
from lt_lib.store.states import after, only
from lt_lib.velocity.coverage import TABLE_2, roll_navigator
from lt_lib.velocity.judgements import commitment
from lt_lib.velocity.navigator import stopped, train_navigator

# What each of the six configurations changes; like the paper's, they vary hazard penalty, discount, curriculum, layout
DIRECT: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "base": {},
        "no hazard penalty": {"hazard": 0.0},
        "hazard penalty x 5": {"hazard": 5.0},
        "discount 0.995": {"ppo": PpoConfig(gamma=0.995)},
        "more spawn curriculum": {"spawn_share": 0.25},
        "wide layout": {"layout": "wide"},
    }
)
# Navigators that nobody tells anything, by where they learn to drive: whether the slab leaves them a choice, and
# whether they also start in front of the mouths. The navigators of Table II have one of these curricula
CURRICULA: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "one corridor, past the mouths": {"content": "floor", "blocked": "right"},
        "either corridor, past the mouths": {"content": "floor"},
        "either corridor, anywhere": {"content": "floor", "starts": "anywhere"},
    }
)
# The controls: the bit itself, the missing coverage supplied by hand, no message, and no choice of corridor
ORACLE, BOTH_MOUTHS, PRETRAINED = "oracle", "shown both mouths", "pretrained"
SILENT = {"silent": "either corridor, past the mouths", "no choice": "one corridor, past the mouths"}
# What might give the bit a use inside the corridor: contact that costs time instead of the episode, time that costs
BITS: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        ORACLE: {"content": "oracle"},
        "slab ends no episode": {"content": "oracle", "slab_ends": False},
        "time costs": {"content": "oracle", "step_cost": 0.01},
    }
)
FRICTIONS = MappingProxyType({0.0: "frictionless", 0.5: "half_friction"})  # and 1.0, the default layout's
# The paper's boost is still 3.6 times the policy's own noise at iteration 80: a straight line that would reach 1 after
# 160. A boost that is held can distinguish suppression from decay; one annealed run cannot
BOOSTS = MappingProxyType(
    {
        "annealed": Boost(first=6.2, last=3.6, at=80),
        "held": Boost(first=6.2, last=6.2, at=80),
    }
)
EARLY, LATE = (0, 14, 28), (66, 73, 80)  # edges of the iterations over which the paper's two ranges are measured
SAMPLED, GREEDY = Exploration(window=0), Exploration(window=0, own=0.0)


class Examined(NamedTuple):
    """Episodes of the frozen navigators, one result per training in each list."""

    spawn: dict[str, list[Result]]  # from the spawn, slab at random; row 0 actions sampled, row 1 without noise
    mouths: dict[str, list[list[Result]]]  # from in front of the left and the right mouth, that corridor free


class Swept(NamedTuple):
    """A frozen navigator under imposed noise, the slab in the corridor that it does not choose."""

    incumbent: int  # the corridor that it enters first in most episodes, 0 left, 1 right
    rows: Result  # of `roll_navigator`

    @property
    def alternative(self) -> int:
        return 1 - self.incumbent

    @property
    def covered(self) -> Bool[np.ndarray, "rows episodes"]:
        """Whether each episode entered the alternative corridor."""
        return self.rows["entered"][..., self.alternative]

    @property
    def shares(self) -> Float[np.ndarray, "rows 2"]:
        """Coverage and success of every row."""
        return np.stack([self.covered.mean(axis=1), self.rows["success"].mean(axis=1)], axis=1)


class Bit(NamedTuple):
    """A frozen navigator told the oracle's bit, without noise."""

    incumbent: int
    flips: dict[tuple[str, bool], Result]  # by blocked corridor and truth of the bit


@dataclass(frozen=True)
class DirectTransfer:
    """The study at one size: navigators trained and examined behind one frozen encoder."""

    store: RunStore
    encoder: Result
    navigator: NavigatorConfig
    rollout: RolloutConfig
    pretraining: PretrainingConfig

    @classmethod
    def of(
        cls,
        protocol: PixelProtocol,
        navigator: Mapping[str, Any],
        rollout: Mapping[str, Any],
        pretraining: Mapping[str, Any],
    ) -> "DirectTransfer":
        """Builds the study from a notebook's parameters.

        navigator, rollout, pretraining  dicts of the fields of NavigatorConfig, RolloutConfig and PretrainingConfig, as
                                         in a profile

        Raises UserError for looks that the trainings cannot take, GateError if the encoder fails its freeze gates.
        """
        kinds = {"navigator": NavigatorConfig, "rollout": RolloutConfig, "pretraining": PretrainingConfig}
        given = {"navigator": navigator, "rollout": rollout, "pretraining": pretraining}
        checked = {name: validated(kind, name, given[name]) for name, kind in kinds.items()}
        require_looks(checked["navigator"], checked["pretraining"])
        shared = {name: getattr(protocol.sizes.head, name) for name in ("layout", "device", "latency")}
        return cls(protocol.store, protocol.encoder_weights(), *(everywhere(each, shared) for each in checked.values()))

    def pretrained(self) -> dict[str, list[Result]]:
        """Silent navigators of every curriculum, `pretraining.seeds` each, with their weights at every look."""
        looks, seeds = self.pretraining.looks, self.pretraining.seeds
        changes = {name: CURRICULA[name] | {"steps": looks[-1], "looks": looks} for name in CURRICULA}
        return self._trained(changes, dict.fromkeys(CURRICULA, seeds), "pretrained navigators")

    def navigators(
        self, configurations: Sequence[str], pretrained: Mapping[str, list[Result]], oracle: Sequence[Result]
    ) -> dict[str, list[Result]]:
        """Every navigator of the null result after `navigator.steps` control steps, by name.

        pretrained  of `pretrained`: the first seeds of two curricula are the controls SILENT, and all seeds of the
                    chosen one are PRETRAINED, the navigators of Table II
        oracle      the oracle's trainings of `told`
        """
        changes = {name: {"content": "latent"} | DIRECT[name] for name in configurations}
        changes |= {BOTH_MOUTHS: {"content": "oracle", "starts": "anywhere"}}
        trained = self._trained(changes, dict.fromkeys(changes, 1), "navigators")
        silent = {name: [self._stopped(pretrained[curriculum][0])] for name, curriculum in SILENT.items()}
        return {
            **{name: trained[name] for name in configurations},
            ORACLE: [self._stopped(each) for each in oracle],
            **silent,
            BOTH_MOUTHS: trained[BOTH_MOUTHS],
            PRETRAINED: [self._stopped(each) for each in pretrained[self.pretraining.curriculum]],
        }

    def told(self, seeds: int) -> dict[str, list[Result]]:
        """Navigators told the oracle's bit, by what else is changed (BITS), with their weights at every look.

        seeds  of the oracle as it is; each change has one
        """
        looks = self.bit_looks
        changes = {name: BITS[name] | {"steps": looks[-1], "looks": looks} for name in BITS}
        return self._trained(changes, {name: seeds if name == ORACLE else 1 for name in BITS}, "told the bit")

    @property
    def bit_looks(self) -> tuple[int, ...]:
        """Control steps after which the use of the bit is measured; `navigator.steps` is one of them."""
        return tuple(sorted({*self.pretraining.bit_looks, self.navigator.steps}))

    def grown(self, pretrained: Mapping[str, list[Result]]) -> Examined:
        """Plays the navigators of every curriculum after the last look, as `examined` does but without greedy rows."""
        last = self.pretraining.looks[-1]
        kept = {name: [after(each, last) for each in trained] for name, trained in pretrained.items()}
        return self._played(kept, (SAMPLED,), self.pretraining.episodes)

    def examined(self, navigators: Mapping[str, list[Result]]) -> Examined:
        """Plays the frozen navigators from the spawn, and from in front of either mouth.

        From the spawn, each navigator gets its own random draws of the scene; from the mouths all get the same.
        """
        return self._played(navigators, (SAMPLED, GREEDY), self.rollout.episodes)

    def _played(self, navigators: Mapping[str, list[Result]], rows: tuple[Exploration, ...], episodes: int) -> Examined:
        everyone = [(name, navigator) for name, results in navigators.items() for navigator in results]
        spawn = [
            self._roll(self._rollout(n, rows=rows, episodes=episodes), r, seed) for seed, (n, r) in enumerate(everyone)
        ]
        brief = {"rows": (SAMPLED,), "episodes": self.pretraining.episodes}
        mouths = [
            self._roll(self._rollout(n, start=side, blocked=other, **brief), r)
            for n, r in everyone
            for side, other in (SIDES, SIDES[::-1])
        ]
        results = iter(self.store.fetch([*spawn, *mouths], "frozen navigators"))
        return Examined(
            {name: [next(results) for _ in trained] for name, trained in navigators.items()},
            {name: [[next(results) for _ in SIDES] for _ in trained] for name, trained in navigators.items()},
        )

    def swept(
        self, trained: Sequence[Result], rows: Sequence[Exploration], episodes: int, layout: str = ""
    ) -> list[Swept]:
        """Plays frozen silent navigators of seeds 0, 1, ... under each row of noise.

        The slab stands in the corridor that a navigator does not choose, which is found first, from the spawn.

        layout  another scene than the study's
        """
        return self._swept(list(enumerate(trained)), tuple(rows), episodes, layout)

    def at_looks(self, trained: Sequence[Result]) -> dict[int, list[Swept]]:
        """Table II after every look of the pretraining, with fewer episodes per row; one navigator per seed."""
        looks, seeds = self.pretraining.looks, list(enumerate(trained))
        kept = [(seed, after(each, look)) for look in looks for seed, each in seeds]
        found = self._swept(kept, tuple(TABLE_2.values()), self.pretraining.episodes)
        return {look: found[i * len(seeds) : (i + 1) * len(seeds)] for i, look in enumerate(looks)}

    def _swept(
        self, navigators: Sequence[tuple[int, Result]], rows: tuple[Exploration, ...], episodes: int, layout: str = ""
    ) -> list[Swept]:
        """As `swept`, for navigators with their seeds."""
        shared = {"episodes": episodes} | ({"layout": layout} if layout else {})
        incumbents = self._incumbents(self._silent(rows=(SAMPLED,), **shared), navigators)
        runs = [
            self._roll(self._silent(rows=rows, blocked=SIDES[1 - incumbent], **shared), r, seed)
            for incumbent, (seed, r) in zip(incumbents, navigators, strict=True)
        ]
        return list(map(Swept, incumbents, self.store.fetch(runs, "coverage sweep")))

    def slippery(self) -> dict[float, list[Swept]]:
        """Table II with other frictions of walls and slab, in training and in the sweep; one navigator per seed."""
        curriculum = CURRICULA[self.pretraining.curriculum]
        changes = {layout: curriculum | {"layout": layout} for layout in FRICTIONS.values()}
        trained = self._trained(changes, dict.fromkeys(changes, self.pretraining.seeds), "navigators by friction")
        rows = tuple(TABLE_2.values())
        return {
            friction: self.swept(trained[layout], rows, self.pretraining.episodes, layout)
            for friction, layout in FRICTIONS.items()
        }

    def boosted(self, starts: Sequence[Result]) -> dict[str, list[Result]]:
        """Trains silent navigators further with the bit: all with the annealed boost, and the first with a held one."""
        runs = {
            (name, seed): Run(
                train_navigator,
                self._config({"content": "oracle", "boost": boost, "steps": self._boosted_steps}),
                seed,
                {"encoder": self.encoder, "start": only(start, "navigator")},
            )
            for name, boost in BOOSTS.items()
            for seed, start in enumerate(starts if name == "annealed" else starts[:1])
        }
        return fetch_by_name(self.store.fetch, runs, "boosted trainings")

    @property
    def _boosted_steps(self) -> int:
        return self.pretraining.boosted * self.navigator.envs * self.navigator.rollout

    def flipped(self, trained: Sequence[Result], episodes: int) -> list[Bit]:
        """Plays frozen navigators that are told the bit under both placements, with the true bit and with its opposite.

        Without noise. All navigators get the same draws of the scene.
        """
        shared = {"content": "oracle", "episodes": episodes}
        incumbents = self._incumbents(self._configured(rows=(GREEDY,), **shared), list(enumerate(trained)))
        cases = [(side, true) for side in SIDES for true in (True, False)]
        configs = [self._configured(rows=(GREEDY,), blocked=side, truthful=true, **shared) for side, true in cases]
        runs = [self._roll(config, r) for r in trained for config in configs]
        results = iter(self.store.fetch(runs, "flipped bits"))
        return [Bit(incumbent, {case: next(results) for case in cases}) for incumbent in incumbents]

    def _incumbents(self, config: RolloutConfig, navigators: Sequence[tuple[int, Result]]) -> list[int]:
        """The corridor that each frozen navigator, given with its seed, enters first in most episodes of a rollout."""
        runs = [self._roll(config, navigator, seed) for seed, navigator in navigators]
        return [commitment(result)[0] for result in self.store.fetch(runs, "incumbent corridors")]

    def _trained(
        self, changes: Mapping[str, Mapping[str, Any]], seeds: Mapping[str, int], what: str
    ) -> dict[str, list[Result]]:
        runs = {
            (name, seed): Run(train_navigator, self._config(change), seed, {"encoder": self.encoder})
            for name, change in changes.items()
            for seed in range(seeds[name])
        }
        return fetch_by_name(self.store.fetch, runs, what)

    def _stopped(self, trained: Result) -> Result:
        steps = self.navigator.steps
        return stopped(trained, steps, steps // (self.navigator.envs * self.navigator.rollout))

    def _config(self, change: Mapping[str, Any]) -> NavigatorConfig:
        return NavigatorConfig(**(self.navigator.model_dump(exclude_computed_fields=True) | dict(change)))

    def _rollout(self, name: str, **changes: Any) -> RolloutConfig:
        """Episodes of a navigator, by its name, in the scene and with the content that it was trained with."""
        content = {ORACLE: "oracle", BOTH_MOUTHS: "oracle"} | dict.fromkeys((*SILENT, *CURRICULA, PRETRAINED), "floor")
        layout = {"layout": DIRECT[name]["layout"]} if "layout" in DIRECT.get(name, {}) else {}
        return self._configured(content=content.get(name, "latent"), **layout, **changes)

    def _silent(self, **changes: Any) -> RolloutConfig:
        return self._configured(content="floor", **changes)

    def _configured(self, **changes: Any) -> RolloutConfig:
        shared = {key: getattr(self.navigator, key) for key in ("layout", "device", "latency", "precision")}
        return self.rollout.model_copy(update=shared | changes)

    def _roll(self, config: RolloutConfig, navigator: Result, seed: int = 0) -> Run:
        return Run(roll_navigator, config, seed, {"encoder": self.encoder, "navigator": only(navigator, "navigator")})


def require_looks(navigator: NavigatorConfig, pretraining: PretrainingConfig) -> None:
    """Raises UserError unless the trainings end with an update at every look, and `navigator.steps` is one."""
    update = navigator.envs * navigator.rollout
    if navigator.steps not in pretraining.looks:
        raise UserError(f"navigator.steps: must be one of pretraining.looks {pretraining.looks}, got {navigator.steps}")
    for name in ("looks", "bit_looks"):
        for look in getattr(pretraining, name):
            if look % update:
                raise UserError(f"pretraining.{name}: expected multiples of {update} control steps, got {look}")
