"""Writes a recording as one HTML file that needs no network, server or library, for browsers and notebooks.

The parts of `page/` and the data are joined to one document, whose content policy forbids loading anything else.
"""

import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax

from scenefactory_jax.env.rollout import Recording
from scenefactory_jax.visualization.birds_eye.drawing import AGENTS, MARKS
from scenefactory_jax.visualization.web import replay_data
from scenefactory_jax.visualization.web.road_posts import RoadPosts
from scenefactory_jax.visualization.web.term_styles import term_looks

if TYPE_CHECKING:
    from IPython.display import HTML

SCRIPTS = ("data.js", "state.js", "view.js", "road.js", "map.js", "charts.js", "rewards.js", "failures.js", "page.js")  # the last starts


class ReplayError(ValueError):
    """A recording that cannot be shown; the message names the argument and what would be valid."""


def write(path: Path | str, recording: Recording, **options: Any) -> Path:
    """Writes the page, about 0.1 to 1 MB per world; options and errors as of `document`."""
    text, path = document(recording, **options), Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def show(recording: Recording, *, height: int = 720, **options: Any) -> "HTML":
    """The page inline in a notebook, `height` pixels high; other options and errors as of `document`."""
    from IPython.display import HTML

    page = html.escape(document(recording, **options), quote=True)
    style = f"width:100%;height:{height}px;border:0"
    return HTML(f'<div><iframe title="replay" style="{style}" srcdoc="{page}"></iframe></div>')


def document(
    recording: Recording,
    *,
    names: Sequence[str] = (),
    posts: Sequence[RoadPosts] = (),
    title: str = "replay",
    goal_radius_m: float | int,
    failures: Sequence[Mapping[int, Mapping[str, Any]]] = (),
    metrics: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """The page as text.

    Args:
        recording: of one or several worlds, see `env.rollout.record`.
        names: of the worlds; empty: numbers.
        posts: lights and stop signs of the worlds (`road_posts.find_posts`); empty: not shown.
        title: of the page.
        goal_radius_m: of the goals' circles.
        failures: of each world, car -> metric -> [first, last] step of each failure, None for a metric without a value, and "counted" ->
            [first, last] of the steps that count; empty: not shown.
        metrics: name -> label of what fails.

    Raises:
        ReplayError: another number of names, posts or failures than of worlds, or an empty recording.
    """
    recording = jax.device_get(recording)
    count, steps = recording.shots.time_s.shape if recording.shots.time_s.ndim == 2 else (0, 0)
    if not count or not steps:
        raise ReplayError(f"recording: expected worlds along the first axis, of at least one step, got {count} worlds of {steps} steps")
    for key, values in (("names", names), ("posts", posts), ("failures", failures)):
        if values and len(values) != count:
            raise ReplayError(f"{key}: expected {count}, one per world, or none, got {len(values)}")
    names, posts, failures = names or [f"world {index}" for index in range(count)], posts or [RoadPosts()] * count, failures or [{}] * count
    shown = zip(names, posts, failures, strict=True)
    worlds = [replay_data.world(recording, i, name=name, posts=post, failures=marks) for i, (name, post, marks) in enumerate(shown)]
    head = {
        "title": title,
        "goal_radius_m": goal_radius_m,
        "colours": [list(colour) for colour in AGENTS],
        "marks": {name: {"label": mark.label, "colour": list(mark.colour)} for name, mark in MARKS.items()},
        "terms": {name: look._asdict() for name, look in term_looks(recording.shots.terms).items()},
        "max_ttc_s": replay_data.MAX_TTC_S,
        "metrics": dict(metrics),
        "worlds": [world for world, _ in worlds],
    }
    arrays = "\n".join(f'<script type="text/plain" class="arrays">{text}</script>' for _, text in worlds)
    parts = {
        "title": html.escape(title),
        "style": _part("replay.css"),
        "head": json.dumps(head, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "arrays": arrays,
        "script": "\n".join(_part(name) for name in SCRIPTS),
    }
    page = _part("page.html")
    for name, text in parts.items():
        page = page.replace(f"<!--{name}-->", text, 1)
    return page


def _part(name: str) -> str:
    return (resources.files("scenefactory_jax.visualization.web") / "page" / name).read_text(encoding="utf-8")
