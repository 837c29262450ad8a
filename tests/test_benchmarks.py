"""The instruments of notebook 10: turns and profiles."""

import time

import numpy as np
import torch

from lt_lib.envs.arena import Arena
from lt_lib.envs.layout import load_layout
from lt_lib.perception.frames import free_poses
from lt_lib.speed.benchmarks import BankCost
from lt_lib.speed.step import mujoco_step
from lt_lib.speed.turns import profile_call, taking_turns


def test_turns_alternate_and_the_first_round_is_not_counted():
    heard = []
    spent = iter([100.0, 0.0, 1.0, 10.0, 2.0, 20.0, 3.0, 30.0])
    now = [0.0]

    def call(name):
        heard.append(name)
        now[0] += next(spent)

    seconds = taking_turns({name: lambda name=name: call(name) for name in "ab"}, 3, lambda: now[0])
    assert heard == list("abababab")
    assert seconds == {"a": 2.0, "b": 20.0}


def test_all_sides_are_timed_with_one_thread_as_in_a_worker():
    before = torch.get_num_threads()
    threads = set()
    torch.set_num_threads(2)
    taking_turns({"a": lambda: threads.add(torch.get_num_threads())}, 1)
    profile_call(lambda: threads.add(torch.get_num_threads()), 1)
    assert threads == {1} and torch.get_num_threads() == 2
    torch.set_num_threads(before)


def _busy():
    end = time.process_time() + 0.05
    while time.process_time() < end:
        pass


def test_a_profile_names_the_function_that_takes_the_time_first():
    table = profile_call(_busy, 3)
    assert len(table) <= 3 and "process_time" in " ".join(table.index[:2]) + "_busy" and table.share.iloc[0] > 0.3
    assert any(name.endswith(":_busy") for name in table.index)


def test_the_bank_pays_after_its_own_price():
    price = BankCost(bank=100.0, head=1.0, live=60.0)
    assert price.heads(1) == (101.0, 60.0) and price.heads(10) == (110.0, 600.0)


def test_mujoco_s_side_of_the_physics_takes_the_same_step():
    layout, rng = load_layout("default"), np.random.default_rng(0)
    arena, n = Arena(layout, 32), 32
    slab, scout = rng.integers(0, 2, n), layout.scout.sample(n, rng)
    arena.reset(np.ones(n, bool), free_poses(layout, slab, rng, apart_from=scout), slab, scout)
    arena.reset(slab == 0, np.tile([0.752, 0.4, 0.3], (n, 1)), slab, scout)  # at the left slab
    action = rng.uniform(-1, 1, (n, 3))
    theirs = mujoco_step(arena, action)()
    arena.step(action)
    assert arena.contact.sum() > 4
    np.testing.assert_allclose(arena.pose, theirs, atol=1e-6)
