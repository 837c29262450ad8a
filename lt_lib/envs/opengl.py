"""The one place where the project opens OpenGL, which only MuJoCo's own pictures need.

`python -m lt_lib.envs.opengl` tells in one line whether it opens here: exit status 0, or 2.
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

# What MuJoCo knows on every system, and what Linux has to be installed for each
NAMES = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw"), "Windows": ("wgl", "glfw")}
OSMESA_PACKAGES = ("libosmesa6",)


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """MuJoCo's renderer for pictures of `height` x `width` pixels. Raises UserError, one line, without OpenGL."""
    require_opengl()
    return mujoco.Renderer(model, height, width)


@cache
def require_opengl() -> None:
    """Has MuJoCo use the OpenGL that `MUJOCO_GL` names, or else the first that opens: EGL, or a window's.

    Raises UserError, one line naming what to install, if none opens.
    """
    # Mesa loads the system's LLVM. Triton brings another and exports its symbols, so that whichever of the two comes
    # second calls into the first one's: after a picture, `import triton` ends the process (torch's optimisers import
    # it). With Triton first, each keeps to its own.
    if importlib.util.find_spec("triton"):
        importlib.import_module("triton")
    for name in _candidates():
        if _opens(name):
            return
    raise UserError(_complaint())


def _opens(name: str) -> bool:
    """Has MuJoCo use an OpenGL by its name, and tries it."""
    with (
        contextlib.suppress(Exception),  # AttributeError, ImportError, RuntimeError or FatalError, by platform
        mock.patch.dict(os.environ, {"MUJOCO_GL": name}),
        warnings.catch_warnings(action="ignore"),
    ):
        importlib.reload(gl_context)
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
        return True
    return False


def install_line() -> str:
    """The command that installs what pictures need on Debian and its like; the packages stand in .binder/apt.txt."""
    return "apt install " + " ".join((ROOT / ".binder" / "apt.txt").read_text(encoding="utf-8").split())


def _candidates() -> tuple[str, ...]:
    """The names to try in turn. Pictures are drawn off screen, so that EGL comes before any display."""
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
