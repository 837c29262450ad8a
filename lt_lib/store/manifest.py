"""What an outputs folder was made with: library versions, commit, machine, seconds per notebook and stage.

An execution that finds its runs finished takes seconds. So that a figure can be drawn anew without the hours of a
sitting from nothing, its entry keeps the seconds, stages and commit of the one that computed more of these same runs.
"""

import json
import logging
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from lt_lib.store.computer import processor
from lt_lib.store.files import write_atomically
from lt_lib.store.journal import lines_since

USED = "runs.json"  # beside the manifest: the runs that each notebook used


def write_manifest(path: Path, root: Path, profile: str, notebooks: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes the manifest; earlier entries of notebooks that did not run this time are kept.

    notebooks: {name: {"status": text, "seconds": float, and as from `computed_since`}} of this time; the names of the
    runs go into `USED` beside the manifest.
    """
    earlier, used = _notebooks_in(path), used_runs(path.parent)
    commit, executed = git_state(root), {}
    for name, entry in notebooks.items():
        entry = dict(entry) | commit
        runs = entry.pop("runs", [])
        own = {key: entry.get(key) for key in ("commit", "seconds", "stages")}
        before = earlier.get(name, {}).get("sitting", own)
        again = runs and runs == used.get(name) and (not entry["stages"] or _computed(own) < _computed(before))
        executed[name] = entry | {"sitting": before if again else own}
        used[name] = runs
    manifest = {
        "profile": profile,
        "versions": versions(root / "requirements.txt"),
        "machine": machine(),
        "notebooks": dict(sorted((earlier | executed).items())),
    }
    write_atomically(path, (json.dumps(manifest, indent=2) + "\n").encode())
    write_atomically(path.with_name(USED), (json.dumps(dict(sorted(used.items())), indent=0) + "\n").encode())


def _computed(sitting: Mapping[str, Any]) -> int:
    """How many runs a sitting computed."""
    return sum(stage["runs"] for stage in sitting["stages"].values())


def used_runs(outputs: Path) -> dict[str, list[str]]:
    """The names of the runs that each notebook of an outputs folder used; empty if none are known."""
    path = outputs / USED
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}
    except (ValueError, TypeError):
        logging.getLogger(__name__).warning("%s is damaged and will be rewritten", path)
        return {}


def _notebooks_in(path: Path) -> dict[str, Any]:
    """The notebooks of an earlier manifest; empty if it is missing or, with a warning, damaged."""
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["notebooks"])
    except (ValueError, KeyError, TypeError):
        logging.getLogger(__name__).warning("%s is damaged and will be rewritten", path)
        return {}


def computed_since(store: Path, position: int, asked_by: str) -> dict[str, Any]:
    """What someone had computed since the store's journal was `position` bytes long.

    "stages"     {function: {"runs": count, "seconds": total}}
    "computers"  that made the results which were used, newly computed or kept
    "runs"       the names of those results' files
    """
    stages: dict[str, dict[str, int | float]] = {}
    computers: set[str] = set()
    runs: set[str] = set()
    for line in lines_since(store, position, asked_by):
        computers |= set(line.get("computers", ()))
        runs |= set(line.get("runs", ()))
        if "function" in line:
            stage = stages.setdefault(line["function"], {"runs": 0, "seconds": 0.0})
            stage["runs"] += 1
            stage["seconds"] = round(stage["seconds"] + line["seconds"], 1)
    return {"stages": stages, "computers": sorted(computers), "runs": sorted(runs)}


def versions(requirements: Path) -> dict[str, str]:
    """Installed versions of Python and of every library pinned in a requirements file."""
    names = re.findall(r"^([\w.-]+)==", requirements.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in names}


def git_state(root: Path) -> dict[str, Any]:
    """The commit checked out and whether anything but outputs differs from it.

    Both are None, with the reason in "no_commit", where `root` is not the top of a git checkout of our own: in an
    unpacked archive, even inside another repository, and in a checkout that git does not trust.
    """
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # a hook names its own

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=own).stdout.strip()

    try:
        top = Path(git("rev-parse", "--show-toplevel"))
        if top.resolve() != root.resolve():
            return _no_commit(f"no git checkout of its own: it lies in that of {top.name}")
        changed = git("status", "--porcelain", "--", ".", ":!outputs")
        return {"commit": git("rev-parse", "HEAD"), "uncommitted_changes": bool(changed)}
    except subprocess.CalledProcessError as error:
        return _no_commit((error.stderr.strip().splitlines() or ["git fails"])[0])
    except OSError as error:
        return _no_commit(f"git does not start ({error.strerror})")


def _no_commit(reason: str) -> dict[str, Any]:
    return {"commit": None, "uncommitted_changes": None, "no_commit": reason}


def machine() -> dict[str, Any]:
    """System, CPU, usable cores, and memory in GiB."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
    }
