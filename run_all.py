"""The whole reproduction: executes the notebooks in order and reports how each went.

    python run_all.py [--profile full|quick|smoke] [--only NAME ... | --beyond] [--workers N | --scheduler ADDRESS]
                       [--outputs DIR] [--runs DIR] [--list]

Exit status: 0 success, 1 a notebook failed, 2 bad input (nothing was computed), 129, 130 or 143 interrupted by a closed
terminal, Ctrl-C or SIGTERM.
"""

import argparse
import contextlib
import hashlib
import json
import logging
import os
import signal
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TextIO
from unittest import mock

from lt_lib.preflight import check_cluster, check_inputs, check_opengl, settled
from lt_lib.settings.base import ROOT, UserError
from lt_lib.settings.profiles import GIVEN, load_profile, notebook_defaults, notebook_names
from lt_lib.store import journal
from lt_lib.store.files import claimed, runs_folder, writable_folder
from lt_lib.store.local import ONE_THREAD, cores
from lt_lib.store.manifest import computed_since, write_manifest
from lt_lib.store.progress import Progress, read_progress

# Without these the notebook can only fail too; the scoreboard joins whatever is there.
NEEDS = {
    "03_gridworld": ("02_encoder",),
    "04_pixels": ("02_encoder",),
    "05_coverage_sweep": ("02_encoder",),
    "07_corruption": ("03_gridworld", "04_pixels"),
    "10_speed": ("03_gridworld", "04_pixels"),
}
# The paper's notebooks come before this number; those from it on, beyond the paper, run with --beyond.
BEYOND = "11"
# Parameters naming things that may be missing or unfit; checked before computing.
INPUTS = (
    "device",
    "layout",
    "weights",
    "seeds",
    "gridworld",
    "peek_layout",
    "frames",
    "effects",
    "gate_file",
    "controls",
    "rungs",
    "candidate",
)
# A notebook whose code calls this draws with OpenGL.
DRAWS = "require_opengl()"
# Signals that end us as Ctrl-C does, where the system has them; SIGHUP is a closed terminal.
SIGNALS = [number for name in ("SIGTERM", "SIGHUP") if (number := getattr(signal, name, None))]
CELL_LIMIT_S = 6 * 3600


@dataclass(frozen=True)
class Plan:
    """What to execute, checked: notebooks in order, the parameters and code of each, and where everything goes.

    runs: the folder of finished runs
    scheduler: the address of the Dask cluster that computes, '' for this machine
    code: a digest of each notebook's code
    """

    root: Path
    profile: str
    outputs: Path
    runs: Path
    scheduler: str
    parameters: Mapping[str, Mapping[str, Any]]
    code: Mapping[str, str]


@dataclass(frozen=True)
class Outcome:
    """How a notebook went: 'ok', 'FAILED' or 'skipped', seconds, the reason in one line, what was computed for it.

    computed: as from `store.manifest.computed_since`
    """

    status: str
    seconds: float
    reason: str = ""
    computed: Mapping[str, Any] = field(default_factory=dict)


class Parser(argparse.ArgumentParser):
    """A parser that raises errors instead of printing them."""

    def error(self, message: str) -> None:
        raise UserError(message)


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Runs the command line for the project in `root`; returns the exit status."""
    try:
        with ended_by_signals():
            return run(parse(arguments), root)
    except UserError as error:
        print(f"run_all: {error}", file=sys.stderr)
        return 2
    except OSError as error:  # a full disk, a folder that became read-only or vanished
        print(f"run_all: {error}; finished runs are kept, the same command resumes from there", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        logging.getLogger("asyncio").disabled = True  # papermill's abandoned cell would complain at exit
        with contextlib.suppress(OSError):  # the terminal may be closed
            print("run_all: interrupted; finished runs are kept, the same command resumes from there", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


def run(options: argparse.Namespace, root: Path) -> int:
    """Carries out the options; returns the exit status. Raises UserError before computing."""
    if options.list:
        print("\n".join(notebook_names(root)))
        return 0
    plan = make_plan(options, root)
    preflight(plan)
    with claimed(plan.outputs), kernels_environment(plan):
        outcomes = execute_all(plan)
    return 0 if all(outcome.status == "ok" for outcome in outcomes.values()) else 1


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """While the block runs, SIGTERM and SIGHUP interrupt as Ctrl-C does; a second signal ends this process at once."""

    def interrupt(number: int, _: FrameType | None) -> None:
        for each in (*SIGNALS, signal.SIGINT):
            signal.signal(each, lambda number, _: os._exit(128 + number))
        raise KeyboardInterrupt(number)

    before = {number: signal.signal(number, interrupt) for number in (*SIGNALS, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def kernels_environment(plan: Plan) -> Iterator[None]:
    """The notebooks' environment: this library, the folder of runs, who asks for them, one thread, no backend."""
    library = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    ours = {"LT_RUNS": str(plan.runs), "PYTHONPATH": library, journal.ASKED_BY: uuid.uuid4().hex} | ONE_THREAD
    with mock.patch.dict(os.environ, ours):
        os.environ.pop("MPLBACKEND", None)
        yield


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = Parser(prog="run_all.py", description="Executes the notebooks in order and reports how each went.")
    parser.add_argument("--profile", default="full", help="a file in params/: full (default), quick or smoke")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="notebooks, such as 04 or pixels")
    parser.add_argument("--beyond", action="store_true", help="the notebooks beyond the paper, instead of the paper's")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes at a time (0: one per core)")
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT")
    parser.add_argument("--outputs", type=Path, metavar="DIR", help="folder of outputs; default: outputs/<profile>")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="folder of finished runs; default: outputs/runs")
    parser.add_argument("--list", action="store_true", help="list the notebooks and stop")
    options = parser.parse_args(arguments)
    if options.only and options.beyond:
        raise UserError("argument --beyond: --only names notebooks of either kind; leave one of them out")
    if options.workers < 0:
        raise UserError(f"argument --workers: expected 0 or more, got {options.workers}")
    if options.workers and options.scheduler:
        raise UserError("argument --scheduler: the cluster provides the workers; leave --workers out")
    return options


def make_plan(options: argparse.Namespace, root: Path) -> Plan:
    """Raises UserError for anything unknown or mistyped in the options, the profile or the notebooks."""
    profile = load_profile(options.profile, root)
    meant = [name for name in profile if (name >= BEYOND) == options.beyond]
    chosen = choose(options.only, list(profile)) if options.only else meant
    # The default stays empty, so that executed notebooks do not depend on the project's location.
    outputs = str(options.outputs.resolve()) if options.outputs else ""
    workers = options.scheduler or options.workers
    given = dict(zip(GIVEN, (options.profile, outputs, workers), strict=True))
    return Plan(
        root=root,
        profile=options.profile,
        outputs=Path(outputs or root / "outputs" / options.profile),
        runs=options.runs.resolve() if options.runs else runs_folder(root),
        scheduler=options.scheduler,
        parameters={name: settled(profile[name], root) | given for name in chosen},
        code={name: code_digest(root, name) for name in chosen},
    )


def code_digest(root: Path, name: str) -> str:
    """sha256 of a notebook's code; its prose and outputs do not count."""
    return hashlib.sha256(json.dumps(code_cells(root, name)).encode()).hexdigest()


def code_cells(root: Path, name: str) -> list[str]:
    cells = json.loads((root / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def choose(wanted: Sequence[str], names: Sequence[str]) -> list[str]:
    """The notebooks meant by names such as '04_pixels', '04', '4' or 'pixels', in numeric order."""
    meant = {name: {name, name[:2], str(int(name[:2])), name[3:]} for name in names}
    for word in wanted:
        if not any(word in aliases for aliases in meant.values()):
            raise UserError(f"argument --only: unknown notebook {word!r}; known: {', '.join(names)}")
    return [name for name in names if meant[name] & set(wanted)]


def preflight(plan: Plan) -> None:
    """Raises UserError for everything that can be known to be wrong before computing."""
    checked: list[dict[str, Any]] = []
    for name, given in plan.parameters.items():
        declared = notebook_defaults(plan.root / "notebooks" / f"{name}.ipynb")
        missing = set(GIVEN) - set(declared)
        if missing:
            raise UserError(f"{name}.ipynb: its parameters cell must declare {', '.join(sorted(missing))}")
        inputs = {key: value for key, value in (declared | given).items() if key in INPUTS}
        if inputs not in checked:  # notebooks share most inputs
            check_inputs(inputs, plan.root)
            checked.append(inputs)
    if any(DRAWS in cell for name in plan.parameters for cell in code_cells(plan.root, name)):
        check_opengl()
    if plan.scheduler:
        check_cluster(plan.scheduler)
    else:
        cores()
    kept = [plan.outputs / name for name in ("logs", "notebooks", "results")]
    for folder in (plan.outputs, *kept):
        writable_folder(folder)
    writable_folder(plan.runs, "name another with --runs")
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        print("run_all: NUMBA_DISABLE_JIT is set: loops run uncompiled, a hundred times slower", file=sys.stderr)


def execute_all(plan: Plan) -> dict[str, Outcome]:
    """Executes every notebook whose needs did not fail, prints a line for each, writes the manifest and the report."""
    outcomes: dict[str, Outcome] = {}
    for name in plan.parameters:
        failed = [need for need in NEEDS.get(name, ()) if need in outcomes and outcomes[need].status != "ok"]
        outcomes[name] = Outcome("skipped", 0.0, f"needs {failed[0]}") if failed else execute(plan, name)
        outcome = outcomes[name]
        print(f"{name:20}{outcome.status:8}{clock(outcome.seconds):>8}  {outcome.reason}".rstrip(), flush=True)
        if len(outcome.computed.get("computers", ())) > 1:
            print(f"{name:20}results of several kinds of computers: {'; '.join(outcome.computed['computers'])}")
        entry = {"status": outcome.status, "seconds": round(outcome.seconds, 1), **outcome.computed}
        write_manifest(plan.outputs / "manifest.json", plan.root, plan.profile, {name: entry})
    judged = [name for name, outcome in outcomes.items() if outcome.status == "ok" and name >= "09"]
    if judged and (plan.outputs / "headline.md").exists():
        from lt_lib.report.site import write_report  # takes seconds, which bad input need not wait for

        write_report(plan.outputs)
        if "09_scoreboard" in judged:
            print_summary(plan.outputs / "headline.md")
    return outcomes


def execute(plan: Plan, name: str) -> Outcome:
    """Executes one notebook. It succeeds if no cell raises and it rewrites its results."""
    log = plan.outputs / "logs" / f"{name}.log"
    results = plan.outputs / "results" / f"{name}.json"
    before = results.stat().st_mtime_ns if results.exists() else None
    started, computed = time.monotonic(), journal.length(plan.runs)
    with log.open("w", encoding="utf-8") as file, live_line(name, plan.runs):
        reason = edited(plan, name) or run_papermill(plan, name, file)
    if not reason and (not results.exists() or results.stat().st_mtime_ns == before):
        reason = f"it ended without writing {shown(results, plan.root)}"
    reason = reason or edited(plan, name)
    if reason:
        reason = f"{reason} (log: {shown(log, plan.root)})"
    made = computed_since(plan.runs, computed, os.environ[journal.ASKED_BY])
    return Outcome("FAILED" if reason else "ok", time.monotonic() - started, reason, made)


def edited(plan: Plan, name: str) -> str:
    """The error if a notebook's code has changed since it was checked, so that its outputs do not match; else ''."""
    try:
        same = code_digest(plan.root, name) == plan.code[name]
    except (OSError, ValueError, KeyError, TypeError):  # missing or half written
        same = False
    return "" if same else f"notebooks/{name}.ipynb was edited during the run; the same command executes the new one"


def run_papermill(plan: Plan, name: str, log: TextIO) -> str:
    """Executes a notebook into <outputs>/notebooks and logs its output; returns the error, or ''."""
    import papermill  # takes seconds, which bad input need not wait for

    from lt_lib.store.kernel import OwnKernel

    executed = plan.outputs / "notebooks" / f"{name}.ipynb"
    try:
        # Relative paths, since papermill writes them into the executed notebook.
        with contextlib.chdir(plan.root), stderr_into(log):
            papermill.execute_notebook(
                f"notebooks/{name}.ipynb",
                literal(shown(executed, plan.root)),
                dict(plan.parameters[name]),
                kernel_name="python3",
                kernel_manager_class=OwnKernel,
                language="python",
                progress_bar=False,
                stdout_file=log,
                stderr_file=log,
                execution_timeout=CELL_LIMIT_S,
                extra_arguments=["--log-level=ERROR"],  # kernels warn of a local TCP port
            )
    except papermill.PapermillExecutionError as error:
        log.write(str(error))
        return f"cell {error.cell_index}: {error.ename}: {first_line(error.evalue)}"
    except (RuntimeError, OSError, ValueError) as error:  # a dead kernel, a cell over its time limit, a full disk
        log.write(traceback.format_exc())
        return f"{type(error).__name__}: {first_line(str(error))}"
    return ""


@contextlib.contextmanager
def stderr_into(file: TextIO) -> Iterator[None]:
    """Redirects stderr of this process and its children to a file."""
    kept = os.dup(2)
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextlib.contextmanager
def live_line(name: str, runs: Path) -> Iterator[None]:
    """While the block runs, reports progress: in one live line on a terminal, else in several."""
    done = threading.Event()
    tell = tell_terminal if sys.stdout.isatty() else tell_file
    thread = threading.Thread(target=tell, args=(name, runs, done), daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def tell_terminal(name: str, runs: Path, done: threading.Event) -> None:
    started = time.monotonic()
    while not done.wait(0.5):
        line = describe(read_progress(runs, since=started), time.monotonic() - started)
        print(f"\r{name:20}{line}\x1b[K", end="", flush=True)
    print("\r\x1b[K", end="", flush=True)


def tell_file(name: str, runs: Path, done: threading.Event) -> None:
    """Prints one line when a stage begins and one per minute after that."""
    started = time.monotonic()
    told, due = "", 0.0
    while not done.wait(0.5):
        progress = read_progress(runs, since=started)
        if progress and (progress.what != told or time.monotonic() > due):
            told, due = progress.what, time.monotonic() + 60
            print(f"{name:20}{describe(progress, time.monotonic() - started)}", flush=True)


def describe(progress: Progress | None, seconds: float) -> str:
    """For instance '12:01  route heads 12/35 (34%), about 2:10 left'."""
    if progress is None:
        return clock(seconds)
    left = "" if progress.left is None else f", about {clock(progress.left)} left"
    return f"{clock(seconds)}  {progress.what} {progress.done}/{progress.total} ({progress.fraction:.0%}){left}"


def clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"


def shown(path: Path, root: Path) -> str:
    """A path, relative to the project's root if it lies inside."""
    return str(path.relative_to(root) if path.is_relative_to(root) else path)


def literal(path: str) -> str:
    """A path for papermill, which would fill in parameters between braces."""
    return path.replace("{", "{{").replace("}", "}}")


def first_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[0]


def print_summary(headline: Path) -> None:
    """Prints what notebook 9 counted, e.g. 'scoreboard: Of 112 independent measured claims: 60 reproduced, ...'."""
    print(f"scoreboard: {headline.read_text(encoding='utf-8').splitlines()[-1]}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
