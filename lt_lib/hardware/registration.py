"""The hardware gates: written down before any camera frame was encoded (Section Hardware)."""

from pathlib import Path

from pydantic import ValidationError

from lt_lib.report.registration import Registration, register
from lt_lib.settings.base import ROOT, UserError
from lt_lib.settings.hardware import HardwareGates
from lt_lib.settings.profiles import explain
from lt_lib.settings.strict_yaml import read_yaml

GATES = ROOT / "params" / "gates" / "hardware.yaml"
RECORD = "hardware_gates.json"


def registered_gates(outputs: Path, path: Path = GATES) -> tuple[HardwareGates, Registration]:
    """The gates as they stand, and their checksum at the first use in an outputs folder.

    Raises UserError, one line, for a gate file or a record that cannot be read.
    """
    return read_gates(path), register("gates", path.read_bytes(), Path(outputs) / RECORD)


def read_gates(path: Path = GATES) -> HardwareGates:
    """Raises UserError, one line, for a file that is missing, no yaml, or not what gates look like."""
    try:
        return HardwareGates.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(explain(error, path.name, HardwareGates)) from None
