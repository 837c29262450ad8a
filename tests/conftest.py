"""Set before any test module is imported: checked array shapes, and one thread."""

import os

import jaxtyping
import pytest
import torch

torch.set_num_threads(1)  # as in a run's worker; two would fight over the cores

import lt_lib.envs.planar  # compiled code, imported before the checks so that they leave it alone
import lt_lib.envs.raycast
import lt_lib.gridworld.table_ppo
import lt_lib.gridworld.walks
import lt_lib.learnability.windows
import lt_lib.perception.first_layer
import lt_lib.perception.recolour
import lt_lib.perception.renewal  # noqa: F401

jaxtyping.install_import_hook("lt_lib", "beartype.beartype")


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project's root with two notebooks that compute; they find our modules, and we their settings."""
    from toy_project import COMPUTE, WRITE, write_notebook
    from toy_runs import ToyConfig

    from lt_lib.settings import base, profiles

    root = tmp_path / "project"
    for folder in ("notebooks", "params"):
        (root / folder).mkdir(parents=True)
    for name in ("02_encoder", "03_gridworld"):
        write_notebook(root, name, COMPUTE, WRITE)
    (root / "params" / "smoke.yaml").write_text("shared: {count: 2}\n02_encoder: {toy: {size: 5}}\n")
    (root / "params" / "claims.yaml").write_text("")
    (root / "requirements.txt").write_text("numpy==2\n")
    monkeypatch.setenv("PYTHONPATH", f"{base.ROOT}{os.pathsep}{base.ROOT / 'tests'}")
    monkeypatch.setitem(profiles.SECTIONS, "toy", ToyConfig)
    return root
