"""The one place where the project opens OpenGL, which only MuJoCo's own renderer needs.

`python -m lt_lib.envs.opengl` exits with status 0 if OpenGL opens here; otherwise it says why in one line and exits
with status 2.
"""

import contextlib
import importlib
import importlib.util
import os
import platform
import sys
import warnings
from functools import cache
from unittest import mock

import mujoco
from mujoco.rendering.classic import gl_context

from lt_lib.settings.base import ROOT, UserError

# The names that MuJoCo knows on each system, and the packages that OSMesa needs on Linux
NAMES = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw"), "Windows": ("wgl", "glfw")}
OSMESA_PACKAGES = ("libosmesa6",)


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """MuJoCo's renderer for pictures of `height` x `width` pixels. Raises a one-line UserError without OpenGL."""
    require_opengl()
    return mujoco.Renderer(model, height, width)


@cache
def require_opengl() -> None:
    """Makes MuJoCo use the OpenGL that `MUJOCO_GL` names, or otherwise the first that opens: EGL, then a window's.

    Raises a one-line UserError that names what to install if none opens.
    """
    # Mesa loads the system's LLVM. Triton ships another LLVM and exports its symbols, so whichever library loads second
    # calls into the LLVM of the first. After a picture, `import triton` then ends the process, and torch's optimisers
    # import Triton. If Triton loads first, each library keeps to its own LLVM.
    if importlib.util.find_spec("triton"):
        importlib.import_module("triton")
    for name in _candidates():
        if _opens(name):
            return
    raise UserError(_complaint())


def _opens(name: str) -> bool:
    """Whether the OpenGL of this name opens; if so, MuJoCo uses it from now on."""
    with (
        contextlib.suppress(
            Exception
        ),  # AttributeError, ImportError, RuntimeError or FatalError, depending on the platform
        mock.patch.dict(os.environ, {"MUJOCO_GL": name}),
        warnings.catch_warnings(action="ignore"),
    ):
        importlib.reload(gl_context)
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
        return True
    return False


def install_line() -> str:
    """The command that installs what rendering needs on Debian-like systems; .binder/apt.txt lists the packages."""
    return "apt install " + " ".join((ROOT / ".binder" / "apt.txt").read_text(encoding="utf-8").split())


def _candidates() -> tuple[str, ...]:
    """The names to try in turn. Pictures are drawn off screen, so EGL comes before any display."""
    named, known = os.environ.get("MUJOCO_GL", "").lower().strip(), NAMES.get(platform.system(), ("glfw",))
    if named:
        return (named,) if named in known else ()
    return tuple(name for name in known if name != "osmesa")


def _complaint() -> str:
    named = os.environ.get("MUJOCO_GL", "")
    known = NAMES.get(platform.system(), ("glfw",))
    if named and named.lower().strip() not in known:
        return f"MUJOCO_GL={named} is no OpenGL that draws here; expected {', '.join(known)}, or leave it out"
    if named == "osmesa":
        return f"MUJOCO_GL=osmesa does not open: apt install {' '.join(OSMESA_PACKAGES)}, or leave MUJOCO_GL out"
    if named == "glfw":
        return f"MUJOCO_GL=glfw does not open on the display {os.environ.get('DISPLAY', '')!r}; leave MUJOCO_GL out"
    if platform.system() == "Linux":
        instead = f"{' '.join(OSMESA_PACKAGES)} and MUJOCO_GL=osmesa"
        return f"no OpenGL opens here, which drawing needs: {install_line()} (or {instead})"
    return "no OpenGL opens here, which drawing needs"


if __name__ == "__main__":
    try:
        require_opengl()
    except UserError as error:
        print(error)
        sys.exit(2)
