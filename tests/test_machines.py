"""Machines as people have them: without OpenGL, with Triton, a second checkout, other line ends, a read-only disk."""

import contextlib
import dataclasses
import errno
import importlib.util
import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import time
from itertools import permutations
from pathlib import Path

import pytest
import torch
from toy_project import COMPUTE, LIMIT_S, WRITE, journal, losses, smoke, write_notebook

from lt_lib.envs.opengl import install_line
from lt_lib.perception.jepa import train_encoder
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.settings.base import ROOT, UserError
from lt_lib.settings.devices import computing_device
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.profiles import notebook_names
from lt_lib.store import cluster
from lt_lib.store.files import claimed, outputs_folder, require_own_checkout
from lt_lib.store.progress import read_progress, stage
from lt_lib.store.run import Run
from run_all import code_cells, ended_by_signals, make_plan, parse, preflight

pytestmark = pytest.mark.slow

README = (ROOT / "README.md").read_text(encoding="utf-8")
needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed here")
needs_root = pytest.mark.skipif(getattr(os, "getuid", lambda: 1)() != 0, reason="only root can do as another user")
needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed here")


def python(code: str, folder: Path = ROOT, **environment: str) -> subprocess.CompletedProcess:
    """Python code in a process of its own, which finds the library of a folder."""
    command, environment = [sys.executable, "-c", code], os.environ | {"PYTHONPATH": str(folder)} | environment
    options = {"cwd": folder, "capture_output": True, "text": True, "timeout": LIMIT_S}
    return subprocess.run(command, env=environment, check=False, **options)


def without(folder: Path, *modules: str, error: str = "ImportError('not here')") -> str:
    """A PYTHONPATH in which modules fail to be imported, as they do where their libraries are missing."""
    hide = f"""import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules}:
            raise {error}
for name in {modules}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())"""
    (folder / "sitecustomize.py").write_text(hide)
    return f"{folder}{os.pathsep}{ROOT}"


@pytest.fixture
def no_opengl(tmp_path):
    error = "AttributeError(\"'NoneType' object has no attribute 'eglQueryString'\")"
    return {"PYTHONPATH": without(tmp_path, "OpenGL", "glfw", error=error)}


@pytest.fixture
def checkout(tmp_path):
    """A second checkout of the library, beside the one that is installed."""
    other = tmp_path / "other"
    other.mkdir()
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "lt_lib", other / "lt_lib", ignore=ignored)
    shutil.copytree(ROOT / "params", other / "params")
    (other / "notebooks").mkdir()
    for name in ("conftest.py", "pyproject.toml"):
        shutil.copy2(ROOT / name, other / name)
    return other


# --- OpenGL


@pytest.mark.parametrize("named", [None, "egl", "osmesa"])
def test_without_opengl_the_library_is_imported_and_drawing_is_refused_in_one_line(no_opengl, named):
    code = """from lt_lib.learnability import predictor
from lt_lib.envs.arena import Arena
from lt_lib.envs.layout import load_layout
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.settings.base import UserError
print(Arena(load_layout("default"), 1).n)
try:
    ReferenceCamera(load_layout("default"))
except UserError as error:
    print(error)"""
    ended = python(code, **no_opengl, **({"MUJOCO_GL": named} if named else {}))
    assert ended.returncode == 0, ended.stderr
    number, complaint = ended.stdout.splitlines()
    assert number == "1"
    assert ("apt install libosmesa6" if named == "osmesa" else install_line()) in complaint


def test_a_notebook_that_draws_is_refused_before_computing_and_one_that_does_not_is_not(no_opengl, monkeypatch):
    for name, value in no_opengl.items():
        monkeypatch.setenv(name, value)
    preflight(make_plan(parse(["--profile", "smoke", "--only", "z_study"]), ROOT))
    ended = subprocess.run(
        [sys.executable, "run_all.py", "--profile", "smoke", "--only", "occlusion_check"],
        cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S, check=False,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == f"run_all: no OpenGL opens here, which drawing needs: {install_line()} " + (
        "(or libosmesa6 and MUJOCO_GL=osmesa)\n"
    )


def test_a_notebook_says_that_it_draws_where_it_opens_a_camera_or_a_film():
    drawing = re.compile(
        r"ReferenceCamera|TopView|lt_lib\.pixels[.\w]* import .*film|step_costs|protocol\.surrogate\(\)"
    )
    for name in notebook_names():
        code = "\n".join(code_cells(ROOT, name))
        assert bool(drawing.search(code)) == ("require_opengl()" in code), name


@pytest.mark.parametrize("named", ["directx", "disable"])
def test_an_unknown_opengl_is_refused_before_computing_only_where_something_is_drawn(monkeypatch, named):
    monkeypatch.setenv("MUJOCO_GL", named)
    preflight(make_plan(parse(["--profile", "smoke", "--only", "z_study"]), ROOT))
    with pytest.raises(UserError, match=f"^MUJOCO_GL={named} is no OpenGL that draws here; expected egl, osmesa, glfw"):
        preflight(make_plan(parse(["--profile", "smoke", "--only", "1"]), ROOT))


def test_a_display_that_does_not_answer_does_not_matter():
    ended = python("from lt_lib.envs.opengl import require_opengl; require_opengl()", DISPLAY=":77")
    assert ended.returncode == 0, ended.stderr


def test_the_list_of_packages_stands_once():
    packages = (ROOT / ".binder" / "apt.txt").read_text().split()
    assert {"libegl1", "libgl1-mesa-dri", "libopengl0"} <= set(packages)
    assert "apt install $(cat .binder/apt.txt)" in README
    assert ".binder/apt.txt" in (ROOT / ".ci" / "fresh-machine").read_text()
    others = [ROOT / ".ci" / "run", ROOT / ".ci" / "fresh-machine", *(ROOT / "lt_lib").rglob("*.py")]
    assert not any("libopengl0" in path.read_text() for path in others)


# --- two copies of LLVM

PICTURE = """import numpy as np
from lt_lib.envs.layout import load_layout
from lt_lib.envs.reference import ReferenceCamera
ReferenceCamera(load_layout("default")).pictures(np.zeros((1, 3)), [0], np.ones((1, 2)))
"""
TRAIN = """import torch
weight = torch.nn.Parameter(torch.ones(1))
adam = torch.optim.Adam([weight])
weight.sum().backward()
adam.step()
"""
COMPILE = {
    "picture": PICTURE,
    "warp": """import warp, warp_kernel
warp.launch(warp_kernel.double, 1, inputs=[warp.zeros(1, device="cpu")], device="cpu")
""",
    "numba": """import numba
numba.njit(lambda x: x + 1)(1)
""",
}


@needs_triton
def test_triton_after_a_picture_ends_the_process_and_before_it_does_not():
    bare = """import mujoco
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 64, 64)
renderer.render()
import triton
"""
    if python(bare, MUJOCO_GL="egl").returncode != -signal.SIGSEGV:
        pytest.skip("this Mesa and this Triton do not clash")
    ended = python(PICTURE + TRAIN + "import triton")
    assert ended.returncode == 0, ended.stderr


WARP_KERNEL = """import warp
@warp.kernel
def double(x: warp.array(dtype=float)):
    x[warp.tid()] *= 2.0
"""


@pytest.mark.parametrize("order", list(permutations(COMPILE)), ids="-".join)
def test_what_brings_an_llvm_may_come_in_any_order(order, tmp_path):
    (tmp_path / "warp_kernel.py").write_text(WARP_KERNEL)
    environment = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    ended = python("".join(COMPILE[name] for name in order) + TRAIN, **environment)
    assert ended.returncode == 0, ended.stderr[-500:]


def test_without_a_picture_triton_is_not_imported(no_opengl):
    code = "import sys, lt_lib.envs.arena, lt_lib.envs.opengl; print('triton' in sys.modules)"
    assert python(code).stdout == "False\n"


# --- two checkouts and one environment


def test_a_notebook_of_another_checkout_is_refused_in_one_line(checkout, monkeypatch):
    monkeypatch.chdir(checkout / "notebooks")
    complaint = (
        f"this notebook is in {checkout}, but the library that it imports is in {ROOT}; start Jupyter with PYTHONPATH"
    )
    with pytest.raises(UserError, match=re.escape(complaint)):
        outputs_folder("", "smoke")
    require_own_checkout(ROOT / "notebooks")


def test_run_all_runs_a_notebook_with_the_library_of_its_own_checkout(checkout):
    notebook(
        checkout,
        "from lt_lib.store.files import outputs_folder\nfolder = outputs_folder(outputs, profile)",
        WRITE_ALONE,
    )
    for name in ("run_all.py", "requirements.txt"):
        shutil.copy2(ROOT / name, checkout / name)
    command = [sys.executable, "run_all.py", "--profile", "smoke"]
    (checkout / "params" / "smoke.yaml").write_text("")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # the other one's
    ended = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert (checkout / "outputs" / "smoke" / "results" / "01_toy.json").exists()


def test_pytest_runs_a_notebook_with_the_library_of_its_own_checkout(checkout):
    notebook(checkout, f"import lt_lib\nassert lt_lib.__path__ == [{str(checkout / 'lt_lib')!r}], lt_lib.__path__")
    ended = pytest_in(checkout)
    assert ended.returncode == 0, ended.stdout[-2000:]


WRITE_ALONE = """(folder / "results" / "01_toy.json").write_text("[]")"""


def notebook(root: Path, *cells: str) -> None:
    write_notebook(root, "01_toy", *cells)


def pytest_in(root: Path) -> subprocess.CompletedProcess:
    """The notebooks of a checkout under its own pytest settings, without what this process put into the environment."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "notebooks/01_toy.ipynb"]
    options = {"cwd": root, "capture_output": True, "text": True, "timeout": LIMIT_S}
    return subprocess.run(command, env=environment, check=False, **options)


# --- kernels


def test_a_kernel_that_dies_under_pytest_is_told_at_once(checkout):
    notebook(checkout, "import os\nos._exit(9)", "print(1)")
    began = time.monotonic()
    ended = pytest_in(checkout)
    assert ended.returncode == 1
    assert "the kernel died in this cell" in ended.stdout
    assert time.monotonic() - began < 120  # it waited for 600 s for every cell


def test_a_kernelspec_that_starts_something_else_does_not_matter(project, tmp_path, monkeypatch):
    spec = tmp_path / "kernels" / "python3" / "kernel.json"
    spec.parent.mkdir(parents=True)
    argv = ["/nowhere/python", "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec.write_text(json.dumps({"argv": argv, "display_name": "Python 3", "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    assert smoke(project, "--only", "02") == 0


def test_an_unknown_backend_of_matplotlib_does_not_matter(project, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "paper")
    write_notebook(project, "02_encoder", "from matplotlib.figure import Figure", COMPUTE, WRITE)
    assert smoke(project, "--only", "02") == 0


def test_loops_that_run_uncompiled_are_told_at_the_start(project, capfd, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert smoke(project, "--only", "02") == 0
    assert capfd.readouterr().err == "run_all: NUMBA_DISABLE_JIT is set: loops run uncompiled, a hundred times slower\n"


# --- line ends


@needs_git
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout of git")
def test_a_checkout_of_windows_has_the_same_bytes(tmp_path):
    clone = ["git", "-c", "core.autocrlf=true", "clone", "--quiet", "--no-local", "--depth", "1", f"file://{ROOT}"]
    subprocess.run([*clone, str(tmp_path / "clone")], check=True, capture_output=True)
    for path in (tmp_path / "clone").rglob("*.*"):
        if path.suffix in (".py", ".md", ".yaml", ".ipynb", ".txt"):
            assert b"\r\n" not in path.read_bytes(), path.name


def test_windows_line_ends_change_neither_a_run_s_key_nor_the_code_that_a_cluster_compares(checkout):
    code = """from lt_lib.store.cluster import code_digest
from lt_lib.settings.perception import EncoderConfig
from lt_lib.perception.jepa import train_encoder
from lt_lib.store.run import Run
print(code_digest(), Run(train_encoder, EncoderConfig(), 0).key())"""
    before = python(code, checkout)
    assert before.returncode == 0, before.stderr
    for path in (checkout / "lt_lib").rglob("*.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert python(code, checkout).stdout == before.stdout


# --- devices


def test_cuda_is_refused_where_there_is_none_before_computing(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    plan = make_plan(parse(["--profile", "smoke", "--only", "encoder"]), ROOT)
    asked = {name: dict(given) | {"device": "cuda"} for name, given in plan.parameters.items()}
    with pytest.raises(UserError, match="^device: cuda: torch finds no CUDA device here, only the CPU; expected cpu"):
        preflight(dataclasses.replace(plan, parameters=asked))
    with pytest.raises(UserError, match="^worker tcp://there:1: device: cuda: torch finds no CUDA device here"):
        cluster.require_device("cuda", "tcp://there:1")


def test_a_run_s_key_holds_the_device_that_computes_it(monkeypatch):
    keys = {}
    for there, device in ((False, "cpu"), (True, "cuda")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert computing_device("auto") == device
        config = PixelProtocol.of({"encoder": {"frames": 64}}, "default", "auto", 0).sizes.encoder
        assert config.device == device
        keys[device] = Run(train_encoder, config, 0).key()
    assert keys["cpu"] != keys["cuda"]
    with pytest.raises(ValueError, match="device"):
        EncoderConfig(device="auto")  # would be the same run on both


# --- disks and users


def test_no_notebook_keeps_runs_in_a_folder_of_its_own_choice():
    for name in notebook_names():
        assert not re.search(r"RunStore\((?!runs_folder\(\))", "\n".join(code_cells(ROOT, name))), name


def test_runs_may_lie_elsewhere(project, tmp_path):
    assert smoke(project, "--only", "02", "--runs", str(tmp_path / "runs")) == 0
    assert len(losses(project, "02_encoder")) == 2
    assert (tmp_path / "runs" / "journal.jsonl").exists() and not journal(project)


@needs_root
def test_a_read_only_checkout_without_a_home_runs_with_outputs_and_runs_elsewhere(project, tmp_path, capfd):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        shutil.copytree(project, disk / "project")
        shutil.copytree(ROOT / "lt_lib", disk / "library" / "lt_lib", ignore=shutil.ignore_patterns("__pycache__"))
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        assert smoke(disk / "project", "--outputs", str(tmp_path / "outputs")) == 2
        assert capfd.readouterr().err.endswith("Read-only file system; name another with --runs\n")
        elsewhere = ["--outputs", str(tmp_path / "outputs"), "--runs", str(tmp_path / "runs")]
        assert smoke(disk / "project", "--only", "02", *elsewhere) == 0
        code = "import numpy as np, lt_lib.perception.renewal as r; r.renew(*np.zeros((4, 1, 1), np.int64))"
        code = code.replace("r.renew(*np.zeros((4, 1, 1), np.int64))", "print(r.renew.__name__)")
        ended = python(code, disk / "library", HOME="/proc/none", XDG_CACHE_HOME="/proc/none", TMPDIR=str(tmp_path))
        assert ended.stdout == "renew\n", ended.stderr
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


def test_a_file_system_without_locks_is_told_and_used(tmp_path, monkeypatch, caplog):
    fcntl = pytest.importorskip("fcntl")
    for number in (errno.ENOLCK, errno.ENOSYS):

        def refuse(*_, number=number):
            raise OSError(number, os.strerror(number))

        folder = tmp_path / str(number)
        folder.mkdir()
        with monkeypatch.context() as patch:
            patch.setattr(fcntl, "flock", refuse)
            with claimed(folder):
                pass
    (told,) = [record.getMessage() for record in caplog.records]
    assert "nothing keeps a second run_all.py out" in told and "No locks available" in told


@needs_root
def test_another_user_s_folder_is_refused_in_one_line(tmp_path):
    tmp_path.chmod(0o777)
    for above in tmp_path.parents:
        if above.is_relative_to("/tmp") and above != Path("/tmp"):
            above.chmod(0o755)
    with claimed(tmp_path):
        pass
    (tmp_path / ".claimed").chmod(0o600)
    code = f"""import os, pathlib
from lt_lib.store.files import claimed
from lt_lib.settings.base import UserError
os.setuid(65534)
try:
    with claimed(pathlib.Path({str(tmp_path)!r})):
        print("claimed")
except UserError as error:
    print(error)"""
    ended = python(code)
    assert ended.stdout == f"{tmp_path} belongs to another user's run; name another with --outputs\n", ended.stderr


# --- signals, clocks, terminals, systems


def test_a_second_signal_ends_at_once():
    code = """import signal, run_all
try:
    with run_all.ended_by_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as interrupt:
            print(interrupt.args, flush=True)
            signal.raise_signal(signal.SIGTERM)
finally:
    print("went on", flush=True)"""
    ended = python(code)
    assert (ended.returncode, ended.stdout) == (128 + signal.SIGTERM, f"({signal.SIGTERM},)\n")


def test_what_was_there_before_handles_signals_again_afterwards():
    before = signal.getsignal(signal.SIGTERM)
    with contextlib.suppress(KeyboardInterrupt), ended_by_signals():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_clock_that_goes_back_does_not_matter(tmp_path, project, monkeypatch, capfd):
    since = time.monotonic()
    hours = iter(range(10**6, 0, -1))
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: 3600.0 * next(hours))
        with stage(tmp_path, "toys", total=2) as (_, finished):
            finished("one")
            progress = read_progress(tmp_path, since)
            assert progress.done == 1 and 0 <= progress.seconds < 60 and progress.left >= 0
        assert smoke(project, "--only", "02") == 0
    manifest = json.loads((project / "outputs" / "smoke" / "manifest.json").read_text())
    assert 0 < manifest["notebooks"]["02_encoder"]["seconds"] < LIMIT_S
    assert re.search(r"^02_encoder +ok +\d+:\d\d$", capfd.readouterr().out, re.MULTILINE)


def test_a_terminal_without_a_width_does_not_matter(project):
    ours, theirs = pty.openpty()  # which has none until one is set
    code = f"""import pathlib, sys, run_all
sys.exit(run_all.main(["--profile", "smoke", "--only", "02"], pathlib.Path({str(project)!r})))"""
    (project / "params" / "smoke.yaml").write_text("")
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=theirs, stderr=theirs, env=os.environ | {"COLUMNS": "0"}
    )
    os.close(theirs)
    said = b""
    with contextlib.suppress(OSError):  # the terminal ends with the process
        while read := os.read(ours, 4096):
            said += read
    assert process.wait(timeout=LIMIT_S) == 0, said
    assert b"02_encoder          ok" in said


def test_modules_that_only_unix_has_are_not_needed(tmp_path, project):
    unix = ("fcntl", "grp", "pwd", "termios", "pty")  # psutil itself wants `resource` on Linux
    code = f"""import pathlib, sys, run_all
assert not set(sys.modules) & set({unix!r})
import lt_lib.store.files, lt_lib.store.progress, lt_lib.store.runs
with lt_lib.store.files.claimed(pathlib.Path({str(tmp_path)!r})):
    sys.exit(run_all.main(["--list"], pathlib.Path({str(project)!r})))"""
    ended = python(code, PYTHONPATH=without(tmp_path, *unix))
    assert (ended.returncode, ended.stdout) == (0, "02_encoder\n03_gridworld\n"), ended.stderr


def test_signals_that_only_unix_has_are_not_needed():
    code = """import signal
del signal.SIGHUP
import run_all
with run_all.ended_by_signals():
    print(run_all.SIGNALS)"""
    assert python(code).stdout == "[<Signals.SIGTERM: 15>]\n"
