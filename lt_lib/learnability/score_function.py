"""The score-function gradient on the point-mass task (Section 'A scalar predictor of learnability').

Many runs advance side by side as rows of one array. Each row has its own generators, keyed by the run's parameters and
not by its row, so a run's result is bit-identical whatever runs beside it.

A policy is two numbers, one per message: the mean lateral command, or the logit of the alternative side.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt32
from scipy.special import expit

from lt_lib.learnability.point_mass import enters_alternative, reward
from lt_lib.learnability.windows import STREAMS, WORDS, clamped_windows
from lt_lib.settings.learnability import UPDATES_PER_LOOK, PointMassConfig

Generators = list[np.random.Generator]
CHUNK = 2_048  # evaluation episodes drawn at once, to bound memory


class Stack(NamedTuple):
    """R runs that share a window of N control steps."""

    window: int
    d: Float[np.ndarray, "r 1"]  # mean lateral command that the alternative side needs
    sigma: Float[np.ndarray, "r 1"]  # of one step's command
    seed: Int[np.ndarray, "r 1"]

    @classmethod
    def of(cls, config: PointMassConfig, seed: int) -> "Stack":
        """Every d with every sigma, `config.seeds` seeds each, starting at `seed`."""
        seeds = np.arange(seed, seed + config.seeds)
        grid = np.meshgrid(config.distances, config.sigmas, seeds, indexing="ij")
        d, sigma, seeds = (values.reshape(-1, 1) for values in grid)
        return cls(config.window, d, sigma, seeds.astype(int))

    def generators(self, arm: str, use: int) -> Generators:
        """One generator per run, for training (0) or for the evaluation after `use` updates."""
        names = sorted(ARMS)
        return [
            np.random.default_rng([seed, names.index(arm), self.window, round(d * 1e6), round(sigma * 1e6), use])
            for d, sigma, seed in zip(self.d.flat, self.sigma.flat, self.seed.flat, strict=True)
        ]


class Arm(NamedTuple):
    """How a policy explores, and whether its message is informative.

    chance  (generator, (batches, episodes), stack) -> the random part of one run's batches, (batches, ...)
    act     (chosen parameter (R, B), a batch's chance (R, ...), stack) -> window's mean command and score, (R, B) each
    signal  whether the message says which side is safe; if not, the side is drawn independently of it
    """

    chance: Callable
    act: Callable
    signal: bool = True


def _window_seeds(rng: np.random.Generator, batches: tuple[int, int], stack: Stack) -> UInt32[np.ndarray, "..."]:
    return rng.integers(0, 2**32, (batches[0], WORDS, STREAMS), dtype=np.uint32)


def _act_by_steps(mean: Float[np.ndarray, "r b"], seeds: UInt32[np.ndarray, "r w s"], stack: Stack):
    """Draws all N commands, clamped to full command at the actuator; the score is the unclamped policy's.

    The score of the window is sum_t (a_t - mu) / sigma^2, with a_t as drawn.
    """
    means, noise = clamped_windows(seeds, mean, stack.sigma, stack.window)
    return means, noise / stack.sigma


def _mean_noise(rng: np.random.Generator, batches: tuple[int, int], stack: Stack) -> Float[np.ndarray, "n b"]:
    return rng.standard_normal(batches)


def _act_by_mean(mean: Float[np.ndarray, "r b"], noise: Float[np.ndarray, "r b"], stack: Stack):
    """Draws the Gaussian mean of N unclamped commands, which decides both the outcome and the score.

    The score of the window is N (mean_t a_t - mu) / sigma^2.
    """
    root = np.sqrt(stack.window)
    return mean + noise * (stack.sigma / root), noise * (root / stack.sigma)


def _uniform(rng: np.random.Generator, batches: tuple[int, int], stack: Stack) -> Float[np.ndarray, "n b"]:
    return rng.random(batches)


def _act_by_draw(logit: Float[np.ndarray, "r b"], noise: Float[np.ndarray, "r b"], stack: Stack):
    """Draws the side once per episode and drives there: twice the command that the alternative needs, or none."""
    probability = expit(logit)
    alternative = noise < probability
    return 2 * stack.d * alternative, alternative - probability


ARMS = {
    "gaussian": Arm(_window_seeds, _act_by_steps),
    "no_signal": Arm(_window_seeds, _act_by_steps, signal=False),
    "categorical": Arm(_uniform, _act_by_draw),
    "unclamped": Arm(_mean_noise, _act_by_mean),
}


class Episodes(NamedTuple):
    """The random part of a batch of B episodes of R runs."""

    message: Bool[np.ndarray, "r b"]
    safe: Bool[np.ndarray, "r b"]  # whether the alternative side is the safe one
    chance: Shaped[np.ndarray, "r ..."]

    @classmethod
    def batches(cls, arm: Arm, stack: Stack, generators: Generators, count: int, size: int) -> "list[Episodes]":
        """`count` batches of `size` episodes; each run draws all of its batches at once."""
        drawn = []
        for rng in generators:
            message = rng.random((count, size)) < 0.5
            safe = message if arm.signal else rng.random((count, size)) < 0.5
            drawn.append((message, safe, arm.chance(rng, (count, size), stack)))
        message, safe, chance = (np.stack(values, axis=1) for values in zip(*drawn, strict=True))
        return [cls(*batch) for batch in zip(message, safe, chance, strict=True)]


def play(arm: Arm, stack: Stack, policy: Float[np.ndarray, "r 2"], episodes: Episodes):
    """Plays episodes under a policy: whether each entered the alternative side, and its score, (R, B) each."""
    chosen = np.where(episodes.message, policy[:, 1:], policy[:, :1])
    command, score = arm.act(chosen, episodes.chance, stack)
    return enters_alternative(command, stack.d), score


def _over_batch(message: Bool[np.ndarray, "r b"], rewards: Float[np.ndarray, "r b"]) -> Float[np.ndarray, "r 1"]:
    return rewards.mean(1, keepdims=True)


def _over_message(message: Bool[np.ndarray, "r b"], rewards: Float[np.ndarray, "r b"]) -> Float[np.ndarray, "r b"]:
    """The mean over the episodes with the same message; the advantage is zero if they all ended alike."""
    means = []
    for which in (~message, message):
        total = np.where(which, rewards, 0.0).sum(1, keepdims=True)
        means.append(total / np.maximum(which.sum(1, keepdims=True), 1))
    return np.where(message, means[1], means[0])


BASELINES = {"batch": _over_batch, "message": _over_message}


def gradient(
    message: Bool[np.ndarray, "r b"], score: Float[np.ndarray, "r b"], advantage: Float[np.ndarray, "r b"]
) -> Float[np.ndarray, "r 2"]:
    """Score-function estimate of the gradient of the expected reward with respect to each message's parameter."""
    weighted = advantage * score
    told = weighted * message
    return np.stack([(weighted - told).mean(1), told.mean(1)], axis=1)


class Adam:
    """Adam with the usual decays; `step` returns the policy's increment."""

    def __init__(self, lr: float, shape: tuple[int, ...]):
        self._lr, self._count = lr, 0
        self._first, self._second = np.zeros(shape), np.zeros(shape)

    def step(self, ascent: Float[np.ndarray, "r 2"]) -> Float[np.ndarray, "r 2"]:
        self._count += 1
        self._first = 0.9 * self._first + 0.1 * ascent
        self._second = 0.999 * self._second + 0.001 * ascent**2
        first, second = self._first / (1 - 0.9**self._count), self._second / (1 - 0.999**self._count)
        return self._lr * first / (np.sqrt(second) + 1e-8)


class Sgd:
    """Plain gradient ascent."""

    def __init__(self, lr: float, shape: tuple[int, ...]):
        self._lr = lr

    def step(self, ascent: Float[np.ndarray, "r 2"]) -> Float[np.ndarray, "r 2"]:
        return self._lr * ascent


OPTIMISERS = {"adam": Adam, "sgd": Sgd}


def train_point_mass(config: PointMassConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Trains R = distances x sigmas x seeds runs of one window length and one arm.

    "d", "sigma", "seed"  (R,)
    "success"   (R, budgets) after each of `config.budgets` updates: share of fresh sampled episodes on the safe side
    "policy"    (R, budgets, 2) the parameters at that point
    "coverage"  (R, looks) share of the training episodes since the previous look that entered the alternative side
    """
    arm, stack, baseline = ARMS[config.arm], Stack.of(config, seed), BASELINES[config.baseline]
    policy = np.zeros((len(stack.d), 2))
    optimiser = OPTIMISERS[config.optimiser](config.lr, policy.shape)
    steps = stack.window if config.score == "mean" else 1
    generators = stack.generators(config.arm, 0)
    kept, coverage = [], []
    for done in range(UPDATES_PER_LOOK, config.budgets[-1] + 1, UPDATES_PER_LOOK):
        shares = []
        for episodes in Episodes.batches(arm, stack, generators, UPDATES_PER_LOOK, config.batch):
            entered, score = play(arm, stack, policy, episodes)
            rewards = reward(entered, episodes.safe)
            advantage = rewards - baseline(episodes.message, rewards)
            policy = policy + optimiser.step(gradient(episodes.message, score / steps, advantage))
            shares.append(entered.mean(1))
        coverage.append(np.mean(shares, axis=0))
        if done in config.budgets:
            kept.append((success_rate(config, stack, policy, done), policy))
        report(done / config.budgets[-1])
    success, policies = (np.stack(values, axis=1) for values in zip(*kept, strict=True))
    runs = {name: getattr(stack, name)[:, 0] for name in ("d", "sigma", "seed")}
    return runs | {"success": success, "policy": policies, "coverage": np.stack(coverage, axis=1)}


def success_rate(
    config: PointMassConfig, stack: Stack, policy: Float[np.ndarray, "r 2"], updates: int
) -> Float[np.ndarray, " r"]:
    """Share of `config.evaluation` fresh episodes on the safe side, the policy sampled as in training."""
    arm, generators = ARMS[config.arm], stack.generators(config.arm, updates)
    won = np.zeros(len(policy))
    for start in range(0, config.evaluation, CHUNK):
        (episodes,) = Episodes.batches(arm, stack, generators, 1, min(CHUNK, config.evaluation - start))
        entered, _ = play(arm, stack, policy, episodes)
        won += reward(entered, episodes.safe).sum(1)
    return won / config.evaluation
