"""Files that were written down before the results, and the proof that nobody changed them afterwards."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from lt_lib.settings.base import UserError
from lt_lib.store.files import write_atomically


class Registration(NamedTuple):
    """The checksum of a file as it stands, and as it was registered at the first use."""

    what: str
    digest: str  # sha256 of the file as it stands
    registered: str  # sha256 at the first use
    first_use: str  # when that was, UTC

    @property
    def changed(self) -> bool:
        return self.digest != self.registered

    def __str__(self) -> str:
        if self.changed:
            return (
                f"CHANGED AFTER THE FACT: the {self.what} were registered on {self.first_use} with sha256 "
                f"{self.registered[:12]}, the file now has {self.digest[:12]}; nothing below counts as pre-registered"
            )
        return f"{self.what} registered on {self.first_use}, sha256 {self.digest[:12]}, unchanged since"


class Registered(NamedTuple):
    """Entries by the day that each was registered, and those that have changed since."""

    what: str
    first_use: Mapping[str, str]
    changed: Sequence[str]

    def __str__(self) -> str:
        if self.changed:
            return f"CHANGED AFTER THE FACT, and so not pre-registered: the {self.what} {', '.join(self.changed)}"
        counts = Counter(self.first_use.values())
        told = ", ".join(f"{count} on {day}" for day, count in sorted(counts.items()))
        return f"{self.what} registered at their first use: {told}; none changed since"


def register_each(what: str, entries: Mapping[str, bytes], record: Path) -> Registered:
    """Leaves the checksum of every entry in `record` the first time that it is there; later, compares with it.

    Raises a one-line UserError for a record that cannot be read.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in entries.items()}
    try:
        kept = dict(json.loads(record.read_text(encoding="utf-8"))) if record.exists() else {}
        known = kept | {name: {"sha256": d, "first_use": now} for name, d in digests.items() if name not in kept}
        changed = [name for name, digest in digests.items() if known[name]["sha256"] != digest]
        first_use = {name: known[name]["first_use"] for name in digests}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{record}: not a record of registered {what} ({error!r})") from None
    if known != kept:
        write_atomically(record, (json.dumps(known, indent=1) + "\n").encode())
    return Registered(what, first_use, changed)


def register(what: str, content: bytes, record: Path) -> Registration:
    """The first time, leaves the checksum of a file's content in `record`; later, compares with it.

    what  the content in a word or two, plural

    Raises a one-line UserError for a record that cannot be read.
    """
    digest = hashlib.sha256(content).hexdigest()
    if not record.exists():
        now = datetime.now(UTC).isoformat(timespec="seconds")
        write_atomically(record, (json.dumps({"sha256": digest, "first_use": now}, indent=1) + "\n").encode())
    try:
        earlier = json.loads(record.read_text(encoding="utf-8"))
        return Registration(what, digest, earlier["sha256"], earlier["first_use"])
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{record}: not a record of registered {what} ({error!r})") from None
