"""The paper's settings as the code has them: what the claims of kind 'config' and the widths are read from."""

from collections.abc import Mapping
from typing import Any

from lt_lib.comm import channel, messages
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs import arena
from lt_lib.envs.layout import Layout
from lt_lib.pixels.protocol import PixelProtocol

LEAST_FOR_THE_RANK_TEST = 5  # seeds a side: p = 1/252 cannot be had with fewer


def out_of_reach(seeds: Mapping[str, int]) -> tuple[str, ...]:
    """Claims that notebook 4 leaves open: the rank test where a profile has too few seeds for it."""
    few = min(seeds["latent"], seeds["floor"]) < LEAST_FOR_THE_RANK_TEST
    return ("px.rank_test",) if few else ()


def pixel_settings(protocol: PixelProtocol, layout: Layout) -> dict[str, Any]:
    """Claim id to value, for the protocol, the scene's rates and the route head."""
    wire = channel.ANCHOR + messages.CONTENT
    raw = channel.ANCHOR + layout.camera.pixels**2 * 3
    ppo = protocol.sizes.head.ppo
    return {
        "wire.latent": messages.CONTENT,
        "wire.anchor": channel.ANCHOR,
        "wire.width": wire,
        "wire.raw": raw,
        "wire.ratio": raw / wire,
        "cfg.latency": channel.measured_latency(protocol.sizes.latency),
        "cfg.control_hz": arena.CONTROL_HZ,
        "cfg.physics_hz": arena.PHYSICS_HZ,
        "cfg.camera": f"{layout.camera.pixels}x{layout.camera.pixels}x3",
        "cfg.fov": layout.camera.fov,
        "cfg.v_max": arena.V_MAX,
        "cfg.w_max": arena.W_MAX,
        "cfg.horizon": arena.HORIZON,
        "cfg.ppo": f"clip {ppo.clip}, {ppo.epochs} epochs, entropy {ppo.entropy}, gamma {ppo.gamma}, lambda {ppo.lam}",
        "px.head_params": sum(p.numel() for p in RouteHead(wire).parameters()),
        "px.commit_step": protocol.sizes.bank.commit_step,
        "px.head_lr": protocol.sizes.head.lr,
        "px.batch": protocol.sizes.head.batch,
        "px.episodes": protocol.sizes.head.episodes,
        "px.envs": protocol.sizes.bank.envs,
        "px.exec_lr": protocol.sizes.executor.lr,
    }
