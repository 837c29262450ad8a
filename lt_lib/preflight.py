"""Checks everything that can be wrong with a notebook's parameters before computing."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lt_lib.settings.base import ROOT, UserError, require_known
from lt_lib.settings.gridworld import GridworldConfig

KINDS = ("encoder", "executor")  # what a weights folder holds


def settled(parameters: Mapping[str, Any], root: Path = ROOT) -> dict[str, Any]:
    """The parameters, with `weights` emptied if it names outputs of a profile that was never run.

    Empty `weights` means training. A missing folder elsewhere is a mistake and is left for `check_inputs` to find.
    """
    folder = root / parameters.get("weights", "")
    never_run = folder.is_relative_to(root / "outputs") and not folder.is_dir()
    return dict(parameters) | ({"weights": ""} if never_run else {})


def check_inputs(parameters: Mapping[str, Any], root: Path = ROOT) -> None:
    """Raises a one-line UserError for parameters that cannot work.

    These are a missing device, an impossible or revealing layout, unusable weights, an unknown condition, camera effect
    or encoder candidate, an invalid gate file, a faulty folder of real frames, and a ladder without a rung that is
    predicted.
    """
    if "device" in parameters:
        from lt_lib.settings.devices import computing_device

        computing_device(parameters["device"])
    if "layout" in parameters:
        from lt_lib.envs.layout import load_layout  # here, since the compiled camera takes seconds to import
        from lt_lib.envs.occlusion import require_occlusion
        from lt_lib.perception.weights import load_frozen

        layout = load_layout(parameters["layout"])
        require_occlusion(layout)
        if parameters.get("weights"):
            for kind in KINDS:
                load_frozen(root / parameters["weights"], kind, layout)
    if "seeds" in parameters:
        from lt_lib.comm.messages import CONDITIONS
        from lt_lib.pixels.redraw import REDRAWS

        require_known(parameters["seeds"], (*CONDITIONS, *REDRAWS), "message condition", "seeds: ")
    if "effects" in parameters:
        _check_hardware(parameters, root)
    if "gridworld" in parameters:
        _check_gridworld(parameters)
    if "controls" in parameters:
        _check_controls(parameters)
    if "candidate" in parameters:
        from lt_lib.hardware.registration import read_gates

        require_known([parameters["candidate"]], read_gates().candidates, "candidate", "candidate: ")


def check_opengl() -> None:
    """Raises a one-line UserError unless OpenGL opens here; tried in a separate process, which a driver may crash."""
    command = [sys.executable, "-m", "lt_lib.envs.opengl"]
    tried = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if tried.returncode:
        raise UserError(tried.stdout.strip() or f"OpenGL crashes on opening (exit status {tried.returncode})")


def check_cluster(address: str) -> None:
    """Raises a one-line UserError unless a scheduler whose workers have our versions answers at the address."""
    from lt_lib.store.cluster import connected  # here, since Dask takes a second to import

    with connected(address):
        pass


def _check_hardware(parameters: Mapping[str, Any], root: Path) -> None:
    from lt_lib.hardware.real_frames import read_sessions
    from lt_lib.hardware.registration import read_gates
    from lt_lib.hardware.sessions import EFFECTS

    require_known(parameters["effects"], EFFECTS, "camera effect", "effects: ")
    read_gates(root / parameters["gate_file"])
    if parameters["frames"]:
        read_sessions(root / parameters["frames"])


def _check_controls(parameters: Mapping[str, Any]) -> None:
    from lt_lib.beyond.protocol import read_rungs
    from lt_lib.envs.layout import load_layout
    from lt_lib.envs.occlusion import require_occlusion

    read_rungs(parameters["rungs"])
    for name in parameters["controls"]["variance"]["layouts"]:
        require_occlusion(load_layout(name))


def _check_gridworld(parameters: Mapping[str, Any]) -> None:
    from lt_lib.envs.layout import load_layout
    from lt_lib.gridworld.map import Grid, require_occluded_choices
    from lt_lib.gridworld.wires import GRID_CONTENTS

    gridworld = GridworldConfig(**parameters["gridworld"])
    require_occluded_choices(Grid(load_layout(gridworld.layout)))
    if "peek_layout" in parameters:
        Grid(load_layout(parameters["peek_layout"]))
    require_known(gridworld.seeds, GRID_CONTENTS, "message content", "gridworld.seeds: ")
