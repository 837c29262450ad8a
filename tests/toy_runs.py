"""Tiny runs for the tests of the run store; workers import them from here."""

import os
import time
from importlib import import_module

import numpy as np
from pydantic import NonNegativeFloat, PositiveInt

from lt_lib.settings.base import Settings


class ToyConfig(Settings):
    size: PositiveInt = 4
    seconds: NonNegativeFloat = 0.0
    fails: bool = False


def train_toy(config, seed, *, report, start=None):
    """Random numbers, after `seconds`, on top of the result of an earlier run."""
    if config.fails:
        raise ValueError("this seed cannot be trained")
    for step in range(10):
        time.sleep(config.seconds / 10)
        report(step / 10)
    weights = np.random.default_rng(seed).normal(size=(config.size, 3))
    return {
        "weights": weights + (start["weights"] if start else 0),
        "loss": float(weights[0, 0]),
        "names": ["a", "b"],
    }


def count_threads(config, seed, *, report):
    """The threads that torch and numba would take in this worker."""
    return {
        "torch": import_module("torch").get_num_threads(),
        "numba": import_module("numba").get_num_threads(),
    }


def lose_worker(config, seed, *, report):
    """Ends its worker process as the kernel does when memory runs out."""
    os._exit(9)
