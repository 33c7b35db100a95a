"""Backends that move the cars of one world: `mjx_car`, `bicycle` and `replay`, each a module with `make(...) -> Dynamics`."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional Warp backend is not installed
    from mujoco import mjx as mjx
