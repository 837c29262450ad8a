"""What pytest runs: notebooks with this checkout's library, a dead kernel told at once, a release only on demand."""

import os
from pathlib import Path
from queue import Empty

import pytest
from nbval.kernel import RunningKernel

ROOT = Path(__file__).resolve().parent
LOOK_S = 2  # between looks at whether a kernel that says nothing is still alive

# Kernels start in notebooks/, where the environment may know another checkout's library.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # tests run side by side, threads would only wait
os.environ.pop("MPLBACKEND", None)  # figures need none, so that an unknown one does not matter


def pytest_report_header() -> list[str]:
    slow = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    return ["NUMBA_DISABLE_JIT is set: loops run uncompiled, a hundred times slower"] if slow else []


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Cells of notebooks are slow; tests of a release wait for `-m release`; what takes longest starts first."""
    items.sort(key=lambda item: item.path.name != "test_smoke.py")  # another worker takes the rest meanwhile
    for item in items:
        if item.path.suffix == ".ipynb":
            item.add_marker("slow")
    if "release" not in config.option.markexpr:
        waiting = [item for item in items if item.get_closest_marker("release")]
        config.hook.pytest_deselected(items=waiting)
        items[:] = [item for item in items if item not in waiting]


class WatchedKernel(RunningKernel):
    """A kernel of nbval's, which would wait for a dead one's answer until the cell's time is over."""

    def get_message(self, stream, timeout=None):
        waited = 0.0
        while True:
            step = LOOK_S if timeout is None else min(LOOK_S, timeout - waited)
            try:
                return super().get_message(stream, step)
            except Empty:
                waited += step
                if not self.is_alive():
                    raise RuntimeError("the kernel died in this cell") from None
                if timeout is not None and waited >= timeout:
                    raise


def pytest_configure() -> None:
    from nbval import plugin

    plugin.RunningKernel = WatchedKernel
