"""What an outputs folder was made with: library versions, commit, machine, seconds per notebook and stage."""

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

from lt_lib.store.files import write_atomically


def write_manifest(path: Path, root: Path, profile: str, notebooks: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes the manifest; earlier entries of notebooks that did not run this time are kept.

    notebooks: {name: {"status": text, "seconds": float, "stages": as from `stages_since`}} of this time.
    """
    earlier = _notebooks_in(path)
    commit = git_state(root)
    executed = {name: dict(entry) | commit for name, entry in notebooks.items()}
    manifest = {
        "profile": profile,
        "versions": versions(root / "requirements.txt"),
        "machine": machine(),
        "notebooks": dict(sorted((earlier | executed).items())),
    }
    write_atomically(path, (json.dumps(manifest, indent=2) + "\n").encode())


def _notebooks_in(path: Path) -> dict[str, Any]:
    """The notebooks of an earlier manifest; empty if it is missing or, with a warning, damaged."""
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["notebooks"])
    except (ValueError, KeyError, TypeError):
        logging.getLogger(__name__).warning("%s is damaged and will be rewritten", path)
        return {}


def stages_since(journal: Path, position: int) -> dict[str, dict[str, int | float]]:
    """Runs computed since the journal was `position` bytes long: {function: {"runs": count, "seconds": total}}."""
    stages: dict[str, dict[str, int | float]] = {}
    if journal.exists():
        for line in journal.read_bytes()[position:].splitlines():
            entry = json.loads(line)
            stage = stages.setdefault(entry["function"], {"runs": 0, "seconds": 0.0})
            stage["runs"] += 1
            stage["seconds"] = round(stage["seconds"] + entry["seconds"], 1)
    return stages


def versions(requirements: Path) -> dict[str, str]:
    """Installed versions of Python and of every library pinned in a requirements file."""
    names = re.findall(r"^([\w.-]+)==", requirements.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in names}


def git_state(root: Path) -> dict[str, Any]:
    """The commit checked out and whether anything but outputs differs from it; None and None outside git."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ".", ":!outputs")
        return {"commit": git("rev-parse", "HEAD"), "uncommitted_changes": bool(changed)}
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "uncommitted_changes": None}


def machine() -> dict[str, Any]:
    """System, CPU, usable cores, and memory in GiB."""
    info = Path("/proc/cpuinfo")
    models = re.findall(r"^model name\s*:\s*(.+)$", info.read_text() if info.exists() else "", flags=re.MULTILINE)
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
    }
