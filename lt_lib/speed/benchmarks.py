"""What the fast paths buy and how costs grow: small stretches of the real work, timed side by side (notebook 10)."""

import cProfile
import json
import pstats
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy import stats

from lt_lib.comm.channel import Channel
from lt_lib.comm.messages import CONTENT, CONTENTS, Sender
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.hardware.matched import train_matched_encoder
from lt_lib.learnability.score_function import train_point_mass
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import SLABS, Draws, draw_scenes, roll_bank
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.pixels.redraw import SCENES, train_redrawn_head
from lt_lib.pixels.route import committed_wires, read_head, train_head
from lt_lib.report.style import ROLES
from lt_lib.settings.hardware import MatchedEncoderConfig
from lt_lib.settings.learnability import PointMassConfig
from lt_lib.settings.velocity import NavigatorConfig
from lt_lib.speed.turns import one_thread, taking_turns
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore
from lt_lib.velocity.navigator import train_navigator

PRECISIONS = ("float32", "bfloat16")


def _unheard(_: float) -> None:
    """A run's progress, which nobody watches here."""


# --- precision
def precision(layout: Layout, encoder: Result, head: Result, scenes: int, rounds: int) -> pd.DataFrame:
    """Either precision of the frozen encoder: its cost, and what it changes in latents and in a frozen head's choices.

    The frames are what the scout sees in so many draws of the scene under both placements; choices are greedy.
    """
    draws = draw_scenes(layout, scenes, np.random.default_rng(0))
    draws, slab = Draws(*(np.repeat(values, SLABS, axis=0) for values in draws)), np.tile(np.arange(SLABS), scenes)
    frames = FastCamera(layout).frames(draws.scout, slab, draws.spawn[:, :2])
    frozen = {name: FrozenEncoder(encoder, precision=name) for name in PRECISIONS}
    seconds = taking_turns({name: lambda each=each: each.latent(frames) for name, each in frozen.items()}, rounds)
    latents = {name: each.latent(frames) for name, each in frozen.items()}
    choices = {name: _choices(layout, each, head, draws, slab, frames) for name, each in frozen.items()}
    reference = PRECISIONS[0]
    rows = {
        name: {
            "microseconds a frame": seconds[name] / len(frames) * 1e6,
            "times as fast": seconds[reference] / seconds[name],
            "largest change of a latent (sd)": (latents[name] - latents[reference]).abs().max().item(),
            "mean change (sd)": (latents[name] - latents[reference]).abs().mean().item(),
            "same route chosen": (choices[name] == choices[reference]).float().mean().item(),
            "route optimality": (choices[name].numpy() == 1 - slab).mean(),
        }
        for name in PRECISIONS
    }
    return pd.DataFrame(rows).T


@torch.no_grad()
def _choices(layout: Layout, frozen: FrozenEncoder, result: Result, draws: Draws, slab, frames) -> torch.Tensor:
    still = np.zeros((len(frames), 2))
    sent = CONTENTS["latent"](Sender(layout, frozen, frames, draws.scout, still, slab))
    channel = Channel((len(sent),), CONTENT, layout.communication_radius)
    wire = committed_wires(channel, channel.latency, sent, draws.scout[:, :2], draws.spawn[:, :2])
    return read_head(result).policy(wire).probs.argmax(1)


# --- the episode bank
class BankCost(NamedTuple):
    """Processor seconds."""

    bank: float  # of the whole bank, every outcome of every draw
    head: float  # of training one head on it
    live: float  # of training one head in the live simulation, one draw an episode

    def heads(self, count: int) -> tuple[float, float]:
        """So many heads by the bank, and live."""
        return self.bank + count * self.head, count * self.live


def bank_against_live(
    protocol: PixelProtocol, bank: Result, encoder: Result, executor: Result, episodes: int
) -> BankCost:
    """What a head costs either way, from so many live episodes and a bank of so many draws, scaled to the real ones."""
    frozen = {"encoder": encoder, "executor": executor}
    scenes = {name: bank[name] for name in SCENES}
    rolled = protocol.sizes.bank.model_copy(update={"entries": episodes})
    once = protocol.sizes.redraw.model_copy(
        update={
            "every": 0,
            "content": "latent",
            "credit": "episode",
            "episodes": episodes,
            "precision": rolled.precision,
        }
    )
    calls = {
        "bank": lambda: roll_bank(rolled, 0, report=_unheard, **frozen),
        "head": lambda: train_head(protocol.sizes.head, 0, report=_unheard, bank=bank, encoder=encoder),
        "live": lambda: train_redrawn_head(once, 0, report=_unheard, scenes=scenes, **frozen),
    }
    seconds = taking_turns(calls, 1)
    return BankCost(
        seconds["bank"] * protocol.sizes.bank.entries * protocol.sizes.shards / episodes,
        seconds["head"],
        seconds["live"] * protocol.sizes.head.episodes / episodes,
    )


# --- cameras
class WarpCost(NamedTuple):
    """The fast camera beside MuJoCo Warp's batch renderer."""

    fast: float  # frames a second of processor time
    warp: float
    same: float  # share of pixels on whose material and face they agree


def camera_against_warp(
    layout: Layout, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"], rounds: int
) -> WarpCost:
    """Both draw the same scenes in turns, Warp on the CPU too; arguments as for `FastCamera.frames`."""
    from lt_lib.envs.warp_camera import WarpCamera  # here, since Warp takes seconds to import

    fast, warp, scenes = FastCamera(layout), WarpCamera(layout, len(eyes)), (eyes, slabs, others)
    same = float((fast.frames(*scenes) == warp.frames(*scenes)).mean())
    seconds = taking_turns({"fast": lambda: fast.frames(*scenes), "warp": lambda: warp.frames(*scenes)}, rounds)
    return WarpCost(len(eyes) / seconds["fast"], len(eyes) / seconds["warp"], same)


# --- workers
def fan_out(config: PointMassConfig, runs: int, workers: Sequence[int]) -> dict[int, float]:
    """Wall-clock seconds of the same runs from nothing, by the number of workers, which have started before."""
    several = [Run(train_point_mass, config, seed * config.seeds) for seed in range(runs + max(workers))]
    seconds = {}
    for count in workers:
        with TemporaryDirectory() as folder:
            store = RunStore(Path(folder), count)
            store.fetch(several[runs : runs + count], "workers start")
            start = time.perf_counter()
            store.fetch(several[:runs], "timed runs")
            seconds[count] = time.perf_counter() - start
    return seconds


# --- growth
class Growth(NamedTuple):
    """Seconds at increasing sizes, and the exponent of the power law through them with its 95% interval."""

    what: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]
    slope: float
    low: float
    high: float


def growth(what: str, calls: Mapping[int, Callable[[], Any]], rounds: int) -> Growth:
    """Times the calls, one a size, and fits a line to the logarithms."""
    seconds = taking_turns(calls, rounds)
    sizes, spent = np.array(list(seconds)), np.array(list(seconds.values()))
    line = stats.linregress(np.log(sizes), np.log(spent))
    reach = line.stderr * stats.t.ppf(0.975, len(sizes) - 2)
    slope = float(line.slope)
    return Growth(what, tuple(sizes.tolist()), tuple(spent.tolist()), slope, slope - float(reach), slope + float(reach))


def of_environments(
    layout: Layout, encoder: Result, executor: Result, precision: str, sizes: Sequence[int]
) -> dict[int, Callable[[], None]]:
    """One control step of so many scenes side by side: picture, latent, velocity, physics."""
    frozen, driver, camera = FrozenEncoder(encoder, precision=precision), FrozenExecutor(executor), FastCamera(layout)

    def stepper(n: int) -> Callable[[], None]:
        arena, rng = Arena(layout, n), np.random.default_rng(0)
        draws, slab, route = draw_scenes(layout, n, rng), rng.integers(0, SLABS, n), rng.integers(0, SLABS, n)
        arena.reset(np.ones(n, bool), draws.spawn, slab, draws.scout)

        def step() -> None:
            latent = frozen.latent(camera.frames(arena.pose, arena.slab, arena.scout[:, :2]))
            arena.step(driver.mean_action(latent, route))

        return step

    return {n: stepper(n) for n in sizes}


def of_seeds(config: PointMassConfig, sizes: Sequence[int]) -> dict[int, Callable[[], dict]]:
    """The point-mass study with so many seeds a setting in one stack."""
    configs = {n: config.model_copy(update={"seeds": n}) for n in sizes}
    return {n: lambda each=each: train_point_mass(each, 0, report=_unheard) for n, each in configs.items()}


def of_episodes(
    protocol: PixelProtocol, bank: Result, encoder: Result, sizes: Sequence[int]
) -> dict[int, Callable[[], dict]]:
    """A route head trained on the bank for so many episodes."""
    configs = {n: protocol.sizes.head.model_copy(update={"episodes": n}) for n in sizes}
    inputs = {"bank": bank, "encoder": encoder}
    return {n: lambda each=each: train_head(each, 0, report=_unheard, **inputs) for n, each in configs.items()}


def growth_figure(growths: Sequence[Growth]) -> Figure:
    """Seconds against size, both logarithmic, a panel a cost; dotted: proportional growth."""
    figure = Figure(figsize=(4.4 * len(growths), 3.8), layout="constrained")
    for axes, each in zip(figure.subplots(1, len(growths), squeeze=False)[0], growths, strict=True):
        sizes, seconds = np.array(each.sizes), np.array(each.seconds)
        axes.loglog(sizes, seconds, "o-", color=ROLES["ours"])
        axes.loglog(sizes, seconds[-1] * sizes / sizes[-1], ":", color="black", lw=1)
        axes.set_title(f"{each.what}\nslope {each.slope:.2f} [{each.low:.2f}, {each.high:.2f}]", fontsize=10)
        axes.set(xlabel=each.what.split(" ")[0], ylabel="processor time (s)")
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
        axes.set_xticks([], minor=True)
    return figure


# --- where the time goes
def stages(manifest: Path) -> pd.DataFrame:
    """Worker seconds of every stage that a manifest tells of, by notebook, and its share of them all; largest first."""
    notebooks = json.loads(manifest.read_text(encoding="utf-8"))["notebooks"] if manifest.exists() else {}
    rows = {
        (name, stage): spent for name, entry in notebooks.items() for stage, spent in entry.get("stages", {}).items()
    }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["runs", "seconds"])
    return table.assign(share=table.seconds / table.seconds.sum()).sort_values("seconds", ascending=False)


def profile(call: Callable[[], Any], most: int) -> pd.DataFrame:
    """The functions that a call spends most of its time in, not counting what they call: seconds and share."""
    profiler = cProfile.Profile()
    with one_thread():
        profiler.runcall(call)
    table = {
        f"{Path(file).name}:{name}" if "~" not in file else name: {"seconds": own, "calls": calls}
        for (file, _, name), (_, calls, own, _, _) in pstats.Stats(profiler).stats.items()
    }
    table = pd.DataFrame(table).T.sort_values("seconds", ascending=False)
    return table.assign(share=table.seconds / table.seconds.sum()).head(most)


def profiles(calls: Mapping[str, Callable[[], Any]], most: int) -> pd.DataFrame:
    """The profile of each call, one below the other."""
    return pd.concat({name: profile(call, most) for name, call in calls.items()})


def training_stretches(
    protocol: PixelProtocol, bank: Result, encoder: Result, executor: Result, episodes: int, steps: int, frames: int
) -> dict[str, Callable[[], dict]]:
    """Stretches of the trainings that take the most time, by stage, to be profiled.

    episodes  of a head that draws at every step;  steps  of a navigator's control;  frames  of a matched encoder
    """
    frozen = {"encoder": encoder, "executor": executor}
    scenes = {name: bank[name] for name in SCENES}
    head = protocol.sizes.redraw.model_copy(
        update={"every": 1, "content": "latent", "credit": "episode", "episodes": episodes}
    )
    navigator = NavigatorConfig(
        steps=steps, layout=protocol.sizes.encoder.layout, precision=protocol.sizes.redraw.precision
    )
    matched = MatchedEncoderConfig(frames=frames, texture=0.1)
    return {
        "train_redrawn_head": lambda: train_redrawn_head(head, 0, report=_unheard, scenes=scenes, **frozen),
        "train_navigator": lambda: train_navigator(navigator, 0, report=_unheard, encoder=encoder),
        "train_matched_encoder": lambda: train_matched_encoder(matched, 0, report=_unheard),
    }
