"""What a result was computed with besides our own code and the libraries: it can change the last digits."""

import os
import platform
import re
from functools import cache
from pathlib import Path

# what compiles or dispatches to other instructions
CHOOSES = re.compile(r"NUMBA_(CPU_\w+|OPT|\w*FASTMATH\w*|ENABLE_AVX|LOOP_VECTORIZE|SLP_VECTORIZE)|ATEN_CPU_CAPABILITY|"
                     r"(ONE)?DNNL?_MAX_CPU_ISA|MKL_ENABLE_INSTRUCTIONS|MKL_CBWR|OPENBLAS_CORETYPE")  # fmt: skip


@cache
def processor() -> str:
    """The CPU's model."""
    info = Path("/proc/cpuinfo")
    models = re.findall(r"^model name\s*:\s*(.+)$", info.read_text() if info.exists() else "", flags=re.MULTILINE)
    return models[0] if models else platform.processor() or platform.machine()


def computer() -> str:
    """The CPU's model and whatever the environment says of its instructions, e.g. 'AMD EPYC, NUMBA_OPT=0'."""
    chosen = [f"{name}={value}" for name, value in sorted(os.environ.items()) if CHOOSES.fullmatch(name)]
    return ", ".join([processor(), *chosen])
