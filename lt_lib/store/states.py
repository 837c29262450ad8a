"""Modules in results: the entries "<prefix>.<name>" are a module's weights."""

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from torch import nn

Module = TypeVar("Module", bound=nn.Module)


def state_of(module: nn.Module, prefix: str) -> dict[str, np.ndarray]:
    """A module's weights as entries of a result, copied, since training goes on in place."""
    return {f"{prefix}.{name}": value.detach().cpu().numpy().copy() for name, value in module.state_dict().items()}


def restored(module: Module, result: Mapping[str, Any], prefix: str) -> Module:
    """The module with its weights from a result; other entries are ignored.

    Raises UserError if the release leaves them out.
    """
    weights = {name.removeprefix(f"{prefix}."): np.asarray(value) for name, value in only(result, prefix).items()}
    module.load_state_dict({name: torch.tensor(value) for name, value in weights.items()})
    return module


def only(result: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A result's weights alone, for runs that do not depend on the course of training."""
    return {name: value for name, value in result.items() if name.startswith(f"{prefix}.")}


def after(trained: Mapping[str, Any], look: int) -> dict[str, Any]:
    """The weights that a training kept after so many control steps, one of its looks.

    They equal those of a training that ends there, since nothing in it depends on its length.
    """
    prefix = f"{look}."
    return {name.removeprefix(prefix): value for name, value in trained.items() if name.startswith(prefix)}
