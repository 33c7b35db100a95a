# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""MuJoCo's renderer without a window.

`mujoco.Renderer` takes the OpenGL backend that was chosen when mujoco was imported: GLFW, unless MUJOCO_GL was set, which fails on Linux
without a display. Here the backend is chosen for the first picture: that of MUJOCO_GL, or EGL on Linux, which needs no display.
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
MAX_GEOMS = 20_000

Paint = Callable[[mujoco.MjvCamera, Callable[[mujoco.MjvScene], None]], UInt8[np.ndarray, "H W 3"]]


class OpenGLError(ValueError):
    """No OpenGL to draw with; the message says what to install or set."""


def check() -> None:
    """Draws an empty picture; errors as of `make_painter`."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with make_painter(model, mujoco.MjData(model), width=8, height=8) as paint:
        paint(mujoco.MjvCamera(), lambda scene: None)


@contextlib.contextmanager
def make_painter(model: mujoco.MjModel, data: mujoco.MjData, *, width: int, height: int) -> Iterator[Paint]:
    """A function (camera, decorate) -> picture of the present `data`; `decorate` may add geoms to the scene.

    Raises:
        OpenGLError: an unknown MUJOCO_GL, or a backend that fails on this machine.
    """
    backend = os.environ.get("MUJOCO_GL", "").lower().strip() or BY_PLATFORM.get(sys.platform, "glfw")
    if backend not in BACKENDS:
        raise OpenGLError(f"MUJOCO_GL: expected {', '.join(BACKENDS)} or nothing, got {backend!r}")
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        context = import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
        renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # whatever the platform's OpenGL raises
        reason = " ".join((str(error) or type(error).__name__).split())
        raise OpenGLError(f"no OpenGL through {backend} here ({reason}); {_suggest(backend)}") from None
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
    renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    scene, options, window = mujoco.MjvScene(model, MAX_GEOMS), mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
    scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True

    def paint(camera: mujoco.MjvCamera, decorate: Callable[[mujoco.MjvScene], None]) -> UInt8[np.ndarray, "H W 3"]:
        mujoco.mjv_updateScene(model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        decorate(scene)
        mujoco.mjr_render(window, scene, renderer)
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, window, renderer)
        return pixels[::-1]

    try:
        yield paint
    finally:
        renderer.free()
        context.free()


def _suggest(backend: str) -> str:
    if sys.platform != "linux":
        return "a 3D picture needs a display here; out=NAME.html needs no OpenGL"
    other = "osmesa" if backend == "egl" else "egl"
    return (
        f"on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri (MUJOCO_GL=egl), or libosmesa6 (MUJOCO_GL=osmesa); "
        f"try MUJOCO_GL={other}; out=NAME.html needs no OpenGL"
    )
