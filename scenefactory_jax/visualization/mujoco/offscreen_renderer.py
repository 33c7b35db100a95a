# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""MuJoCo's renderer without a window: a context of the machine's OpenGL, and pictures through it.

`mujoco.Renderer` decides on the kind of context when mujoco is imported, and wrongly on a Linux machine without a display. This asks when
the first picture is wanted: what MUJOCO_GL names, otherwise EGL on Linux, which needs no display.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from importlib import import_module

import mujoco
import numpy as np
from jaxtyping import UInt8

BACKENDS = ("egl", "osmesa", "glfw", "cgl")
BY_PLATFORM = {"linux": "egl", "darwin": "cgl"}  # otherwise glfw
MOST = 20_000  # geoms of a picture

Paint = Callable[[mujoco.MjvCamera, Callable[[mujoco.MjvScene], None]], UInt8[np.ndarray, "H W 3"]]


class OpenGLError(ValueError):
    """No OpenGL to draw with; the message says what to install or set."""


def backend() -> str:
    """Which kind of context to make.

    Raises:
        OpenGLError: MUJOCO_GL names none.
    """
    named = os.environ.get("MUJOCO_GL", "").lower().strip() or BY_PLATFORM.get(sys.platform, "glfw")
    if named not in BACKENDS:
        raise OpenGLError(f"MUJOCO_GL: {named!r}; valid: {', '.join(BACKENDS)}, or not set")
    return named


def check() -> None:
    """Draw one picture of nothing, before anybody waits for others.

    Raises:
        OpenGLError: see `painter`.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with make_painter(model, mujoco.MjData(model), width=8, height=8) as paint:
        paint(mujoco.MjvCamera(), lambda scene: None)


@contextlib.contextmanager
def make_painter(model: mujoco.MjModel, data: mujoco.MjData, *, width: int, height: int) -> Iterator[Paint]:
    """A function (camera, decorate) -> picture of `data` as it then is; `decorate` may add geoms to the scene.

    Raises:
        OpenGLError: no OpenGL here, with the reason and the way out in one line.
    """
    named = backend()
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        context = import_module(f"mujoco.{named}").GLContext(width, height)
        context.make_current()
        drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # whatever the platform's OpenGL raises
        reason = " ".join((str(error) or type(error).__name__).split())
        raise OpenGLError(f"no OpenGL through {named} here ({reason}); {_way_out(named)}") from None
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
        drawing.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        scene, options, window = mujoco.MjvScene(model, MOST), mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
        scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True

        def paint(camera: mujoco.MjvCamera, decorate: Callable[[mujoco.MjvScene], None]) -> UInt8[np.ndarray, "H W 3"]:
            mujoco.mjv_updateScene(model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
            decorate(scene)
            mujoco.mjr_render(window, scene, drawing)
            pixels = np.empty((height, width, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, window, drawing)
            return pixels[::-1]

        yield paint
    finally:
        drawing.free()
        context.free()


def _way_out(named: str) -> str:
    if sys.platform != "linux":
        return "a 3D picture needs a display here; out=NAME.html needs no OpenGL"
    other = "osmesa" if named == "egl" else "egl"
    return (
        f"on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri (MUJOCO_GL=egl), or libosmesa6 (MUJOCO_GL=osmesa); "
        f"try MUJOCO_GL={other}; out=NAME.html needs no OpenGL"
    )
