"""The device that a training computes on."""

from typing import Literal

import torch

from lt_lib.settings.base import UserError


def computing_device(name: Literal["auto", "cpu", "cuda"]) -> Literal["cpu", "cuda"]:
    """The device meant on this machine: 'auto' is cuda if available. Raises UserError for a missing one."""
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UserError("device: cuda: torch finds no CUDA device here, only the CPU; expected cpu or auto")
    return "cuda" if available and name != "cpu" else "cpu"
