"""Direct transfer to velocity control: the runs of the study (Section From Grid Actions to Velocity Commands).

Notebook 5 fetches them from here. All navigators share one set of settings and differ only in what their names say.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from lt_lib.envs.layout import SIDES
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.settings.base import everywhere
from lt_lib.settings.ppo import PpoConfig
from lt_lib.settings.profiles import validated
from lt_lib.settings.velocity import Boost, Exploration, NavigatorConfig, RolloutConfig
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore
from lt_lib.store.states import only
from lt_lib.velocity.coverage import roll_navigator
from lt_lib.velocity.navigator import train_navigator

SEED = 0
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
# The controls: the bit itself, no message, no choice of corridor, and the missing coverage supplied by hand
OTHERS: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "oracle": {"content": "oracle"},
        "silent": {"content": "floor"},
        "no choice": {"content": "floor", "blocked": "right"},
        "shown both mouths": {"content": "oracle", "starts": "anywhere"},
    }
)
# The paper's boost is still 3.6 times the policy's own noise at iteration 80: a straight line that would reach 1 after
# 160. A boost that is held can distinguish suppression from decay; one annealed run cannot
BOOSTS = MappingProxyType(
    {
        "annealed": Boost(first=6.2, last=3.6, at=80),
        "held": Boost(first=6.2, last=6.2, at=80),
        "none": Boost(),
    }
)
EARLY, LATE = (0, 14, 28), (66, 73, 80)  # edges of the iterations over which the paper's two ranges are measured
SAMPLED, GREEDY = Exploration(window=0), Exploration(window=0, own=0.0)


class Examined(NamedTuple):
    """Episodes of the frozen navigators, one result per training in each list."""

    spawn: dict[str, list[Result]]  # from the spawn, slab at random; row 0 actions sampled, row 1 without noise
    mouths: dict[str, list[list[Result]]]  # from in front of the left and the right mouth, that corridor free
    flips: dict[tuple[str, bool], list[Result]]  # the oracle's, without noise, by blocked corridor and truth of the bit


@dataclass(frozen=True)
class DirectTransfer:
    """The study at one size: navigators trained and examined behind one frozen encoder."""

    store: RunStore
    encoder: Result
    navigator: NavigatorConfig
    rollout: RolloutConfig

    @classmethod
    def of(cls, protocol: PixelProtocol, navigator: Mapping[str, Any], rollout: Mapping[str, Any]) -> "DirectTransfer":
        """Builds the study from a notebook's parameters.

        navigator, rollout  dicts of the fields of NavigatorConfig and RolloutConfig, as in a profile

        Raises GateError if the encoder fails its freeze gates.
        """
        given = validated(NavigatorConfig, "navigator", navigator), validated(RolloutConfig, "rollout", rollout)
        shared = {name: getattr(protocol.sizes.head, name) for name in ("layout", "device", "latency")}
        return cls(protocol.store, protocol.encoder_weights(), *(everywhere(each, shared) for each in given))

    def navigators(self, configurations: Sequence[str], oracle_seeds: int) -> dict[str, list[Result]]:
        """Trains all navigators from scratch; returns them by name: `oracle_seeds` of the oracle, one of each other."""
        runs = {
            (name, seed): Run(train_navigator, self._config(name), seed, {"encoder": self.encoder})
            for name in (*configurations, *OTHERS)
            for seed in range(oracle_seeds if name == "oracle" else 1)
        }
        results = dict(zip(runs, self.store.fetch(list(runs.values()), "navigators"), strict=True))
        return {name: [results[key] for key in runs if key[0] == name] for name, _ in runs}

    def _config(self, name: str) -> NavigatorConfig:
        changes = {"content": "latent"} | DIRECT[name] if name in DIRECT else OTHERS[name]
        return NavigatorConfig(**(self.navigator.model_dump(exclude_computed_fields=True) | changes))

    def examined(self, navigators: Mapping[str, list[Result]]) -> Examined:
        """Plays the frozen navigators from the spawn, from in front of either mouth, and with the oracle's bit flipped.

        From the spawn, each navigator gets its own random draws of the scene; in all other cases all get the same.
        """
        everyone = [(name, navigator) for name, results in navigators.items() for navigator in results]
        spawn = [self._roll(self._rollout(n, rows=(SAMPLED, GREEDY)), r, seed) for seed, (n, r) in enumerate(everyone)]
        mouths = [
            self._roll(self._rollout(n, rows=(SAMPLED,), start=side, blocked=other), r)
            for n, r in everyone
            for side, other in (SIDES, SIDES[::-1])
        ]
        cases = [(side, true) for side in SIDES for true in (True, False)]
        configs = [self._rollout("oracle", rows=(GREEDY,), blocked=side, truthful=true) for side, true in cases]
        flipped = [self._roll(config, navigator) for config in configs for navigator in navigators["oracle"]]
        results = iter(self.store.fetch([*spawn, *mouths, *flipped], "frozen navigators"))
        return Examined(
            {name: [next(results) for _ in trained] for name, trained in navigators.items()},
            {name: [[next(results) for _ in SIDES] for _ in trained] for name, trained in navigators.items()},
            {case: [next(results) for _ in navigators["oracle"]] for case in cases},
        )

    def explored(
        self, navigator: Result, blocked: str, groups: Sequence[tuple[Exploration, ...]]
    ) -> tuple[list[Result], dict[str, Result]]:
        """Sweeps a navigator that was trained without a message, and trains it further with the bit.

        navigator  a result of `train_navigator`
        blocked    the slab's corridor throughout the sweep
        groups     rows of the sweep, one run per group

        Returns one result of `roll_navigator` per group, and the further trainings by the name of their boost.
        """
        swept = [self._roll(self._rollout("no choice", rows=rows, blocked=blocked), navigator) for rows in groups]
        inputs = {"encoder": self.encoder, "start": only(navigator, "navigator")}
        boosted = [
            Run(train_navigator, self._config("oracle").model_copy(update={"boost": boost}), SEED, inputs)
            for boost in BOOSTS.values()
        ]
        results = self.store.fetch([*swept, *boosted], "coverage sweep and boosted trainings")
        return results[: len(swept)], dict(zip(BOOSTS, results[len(swept) :], strict=True))

    def _rollout(self, name: str, **changes: Any) -> RolloutConfig:
        trained = self._config(name)
        shared = {key: getattr(trained, key) for key in ("layout", "device", "content", "latency", "precision")}
        return self.rollout.model_copy(update=shared | changes)

    def _roll(self, config: RolloutConfig, navigator: Result, seed: int = SEED) -> Run:
        return Run(roll_navigator, config, seed, {"encoder": self.encoder, "navigator": only(navigator, "navigator")})
