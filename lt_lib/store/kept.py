"""The runs that come with a release, so that its notebooks open in seconds instead of hours.

    python -m lt_lib.store.kept

copies the runs that outputs/full used from the folder of finished runs to outputs/kept, compressed, and removes what
was kept before. A run that is computed faster than its bytes are worth, such as the frames of a film, is left out.
"""

import json
import lzma
import sys
from pathlib import Path

from lt_lib.settings.base import ROOT, UserError
from lt_lib.store.files import runs_folder, write_atomically
from lt_lib.store.journal import JOURNAL
from lt_lib.store.manifest import used_runs
from lt_lib.store.runs import COMPRESSED

WORTH = 10.0  # seconds of computing per compressed megabyte


def keep(outputs: Path, runs: Path, kept: Path) -> int:
    """Keeps the runs that an outputs folder used; returns the bytes that they take.

    Raises UserError where a used run is not in the folder of finished runs.
    """
    names = {name for used in used_runs(outputs).values() for name in used}
    if missing := sorted(name for name in names if not (runs / name).exists()):
        raise UserError(f"{runs} lacks {len(missing)} runs that {outputs} used ({missing[0]}); run_all.py makes them")
    seconds, total = run_seconds(runs), 0
    for name in sorted(names):
        path = kept / f"{name}{COMPRESSED}"
        content = lzma.compress((runs / name).read_bytes())
        if seconds.get(Path(name).stem, 0.0) >= WORTH * len(content) / 1e6:
            write_atomically(path, content)
            total += len(content)
        else:
            names.remove(name)
    for path in kept.glob(f"*/*{COMPRESSED}"):
        if path.relative_to(kept).as_posix().removesuffix(COMPRESSED) not in names:
            path.unlink()
    return total


def run_seconds(runs: Path) -> dict[str, float]:
    """Seconds that each run took to compute, by key, from the journal of a folder of runs."""
    seconds = {}
    for line in (runs / JOURNAL).read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
            seconds[entry["key"]] = float(entry["seconds"])
        except (ValueError, KeyError, TypeError):  # a fetch, or a line that a full disk cut short
            continue
    return seconds


if __name__ == "__main__":
    try:
        size = keep(ROOT / "outputs" / "full", runs_folder(), ROOT / "outputs" / "kept")
    except UserError as error:
        sys.exit(f"kept: {error}")
    print(f"{size / 1e6:.1f} MB of runs are kept in outputs/kept")
