"""Pre-registration: gates that were written down first, and the proof that nobody changed them afterwards."""

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from lt_lib.settings.base import ROOT, UserError, read_yaml
from lt_lib.settings.hardware import HardwareGates
from lt_lib.settings.profiles import explain
from lt_lib.store.files import write_atomically

GATES = ROOT / "params" / "gates" / "hardware.yaml"
RECORD = "hardware_gates.json"


class Registration(NamedTuple):
    """Gates as they stand, and as they were registered at the first use."""

    gates: HardwareGates
    digest: str  # sha256 of the file as it stands
    registered: str  # sha256 at the first use
    first_use: str  # when that was, UTC

    @property
    def changed(self) -> bool:
        return self.digest != self.registered

    def __str__(self) -> str:
        if self.changed:
            return (
                f"CHANGED AFTER THE FACT: the gates were registered on {self.first_use} with sha256 "
                f"{self.registered[:12]}, the file now has {self.digest[:12]}; nothing below counts as pre-registered"
            )
        return f"gates registered on {self.first_use}, sha256 {self.digest[:12]}, unchanged since"


def register(outputs: Path, path: Path = GATES) -> Registration:
    """Reads the gates; the first time it leaves their checksum in the outputs folder, later it compares with it.

    Raises UserError, one line, for a gate file or a record that cannot be read.
    """
    gates, digest = read_gates(path), hashlib.sha256(path.read_bytes()).hexdigest()
    record = Path(outputs) / RECORD
    if not record.exists():
        now = datetime.now(UTC).isoformat(timespec="seconds")
        write_atomically(record, (json.dumps({"sha256": digest, "first_use": now}, indent=1) + "\n").encode())
    try:
        earlier = json.loads(record.read_text(encoding="utf-8"))
        return Registration(gates, digest, earlier["sha256"], earlier["first_use"])
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{record}: not a record of registered gates ({error!r})") from None


def read_gates(path: Path = GATES) -> HardwareGates:
    """Raises UserError, one line, for a file that is missing, no yaml, or not what gates look like."""
    try:
        return HardwareGates.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(explain(error, path.name, HardwareGates)) from None
