"""The device that a training computes on, and the precision of its frozen encoder."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from lt_lib.settings.base import UserError


def computing_device(name: Literal["auto", "cpu", "cuda"]) -> Literal["cpu", "cuda"]:
    """The device meant on this machine: 'auto' is cuda if available. Raises UserError for a missing one."""
    import torch  # here, since it takes seconds to import, which bad settings need not wait for

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UserError("device: cuda: torch finds no CUDA device here, only the CPU; expected cpu or auto")
    return "cuda" if available and name != "cpu" else "cpu"


def computing_precision(name: Any) -> Any:
    """The precision meant on this machine: 'auto' is bfloat16 where the CPU multiplies numbers of it, else float32.

    On other CPUs bfloat16 is emulated, at half the speed of float32. Linux alone says what the CPU can do.
    """
    if name != "auto":
        return name
    info = Path("/proc/cpuinfo")
    flags = info.read_text() if info.exists() else ""
    return "bfloat16" if "amx_bf16" in flags or "avx512_bf16" in flags else "float32"


# resolved when settings are read, so that a run's key names the precision that computed it
Precision = Annotated[Literal["float32", "bfloat16"], BeforeValidator(computing_precision)]
