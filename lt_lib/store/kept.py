"""The runs that come with a release, so that its notebooks open in seconds instead of hours.

    python -m lt_lib.store.kept

copies the runs that outputs/full used from the folder of finished runs to outputs/kept, compressed, and removes what
was kept before. A run that is computed faster than its bytes are worth, such as the frames of a film, stays behind; so
do weights that only later runs start from, since these are kept themselves.
"""

import json
import lzma
import sys
from pathlib import Path

from lt_lib.settings.base import ROOT, UserError
from lt_lib.store.files import runs_folder, write_atomically
from lt_lib.store.journal import JOURNAL
from lt_lib.store.manifest import used_runs
from lt_lib.store.run import Result, bare, pack
from lt_lib.store.runs import COMPRESSED, checked, sealed

WORTH = 5.0  # seconds of computing per compressed megabyte
STARTED_FROM = ("train_navigator", "train_grid_end_to_end", "train_grid_reader", "train_radio")
FIRST_SHOWN = ("train_encoder", "train_end_to_end", "train_grid", "train_head")  # notebooks show the weights of seed 0


def keep(outputs: Path, runs: Path, kept: Path) -> int:
    """Keeps the runs that an outputs folder used; returns the bytes that they take.

    Raises UserError for a used run that the folder of finished runs lacks, before anything is written, or has damaged.
    """
    names = {name for used in used_runs(outputs).values() for name in used}
    if missing := sorted(name for name in names if not (runs / name).exists()):
        raise UserError(f"{runs} lacks {len(missing)} runs that {outputs} used ({missing[0]}); run_all.py makes them")
    computed, sizes = computed_runs(runs), {}
    for name in sorted(names):
        seed, seconds = computed.get(Path(name).stem, (0, 0.0))
        path, content = kept / f"{name}{COMPRESSED}", compressed(runs / name, seed)
        if seconds >= WORTH * len(content) / 1e6:
            write_atomically(path, content)
            sizes[path] = len(content)
    for path in set(kept.glob(f"*/*{COMPRESSED}")) - sizes.keys():
        path.unlink()
    return sum(sizes.values())


def compressed(path: Path, seed: int) -> bytes:
    """A finished run's file as a release keeps it. Raises UserError where it is damaged."""
    run = checked(path.read_bytes())
    if not run:
        raise UserError(f"{path} is truncated or altered; run_all.py makes it again")
    result, made_on = run
    return lzma.compress(sealed(pack(lightened(result, path.parent.name, seed)), made_on))


def lightened(result: Result, function: str, seed: int) -> Result:
    """The result of a run without the weights that notebooks do not look at."""
    if function in STARTED_FROM or (function in FIRST_SHOWN and seed):
        weights = {name: value for name, value in result.items() if name.endswith(".weight")}
        return result | bare(weights)
    return result


def computed_runs(runs: Path) -> dict[str, tuple[int, float]]:
    """The seed of each run that a folder of runs computed, and the seconds it took, by key."""
    found = {}
    for text in (runs / JOURNAL).read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
            found[line["key"]] = int(line["seed"]), float(line["seconds"])
        except (ValueError, KeyError, TypeError):  # a fetch, or a line that a full disk cut short
            continue
    return found


if __name__ == "__main__":
    try:
        size = keep(ROOT / "outputs" / "full", runs_folder(), ROOT / "outputs" / "kept")
    except UserError as error:
        sys.exit(f"kept: {error}")
    print(f"{size / 1e6:.1f} MB of runs are kept in outputs/kept")
