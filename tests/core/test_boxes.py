"""The shortest way between rectangles, against points along their outlines."""

import jax
import numpy as np

from scenefactory_jax.core.boxes import CORNERS, Placed, find_shortest_way

FAR, POINTS, STEP = 12.0, 201, 0.04  # m between points of the longest side


def outline(placed: Placed) -> np.ndarray:
    """Points of a rectangle's outline, [M, 2]."""
    corners = [np.array(sign) * [placed.half_length, placed.half_width] for sign in CORNERS]
    turn = np.array([[placed.cos, -placed.sin], [placed.sin, placed.cos]])
    sides = [a + np.linspace(0, 1, POINTS)[:, None] * (b - a) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
    return np.concatenate(sides) @ turn.T + [placed.x, placed.y]


def test_shortest_way_is_that_between_outlines():
    random = np.random.default_rng(0)
    count = 60
    yaw = random.uniform(-np.pi, np.pi, count)
    others = Placed(*random.uniform(-FAR, FAR, (2, count)), np.cos(yaw), np.sin(yaw), *random.uniform(0.3, 4.0, (2, count)))
    half = random.uniform(0.3, 4.0, (2, count))
    way = np.stack(jax.jit(find_shortest_way)(*half, others), axis=-1)
    apart = []
    for row in range(count):
        other = Placed(*(component[row] for component in others))
        mine = outline(Placed(0.0, 0.0, 1.0, 0.0, *half[:, row]))
        nearest = np.min(np.linalg.norm(mine[:, None] - outline(other)[None], axis=-1))
        if nearest > STEP:  # else they overlap
            apart.append(nearest - np.linalg.norm(way[row]))
    assert len(apart) > count / 2
    assert min(apart) >= -1e-5 and max(apart) <= STEP


def test_shortest_way_by_hand():
    """Side by side, corner to corner, and a corner inside."""
    find = jax.jit(find_shortest_way)
    across = Placed(0.5, 3.0, 0.0, 1.0, 2.0, 1.0)  # 4 x 2 m, turned by 90 degrees: its end is 1 m above the centre
    np.testing.assert_allclose(find(2.0, 0.75, across), [0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(find(2.0, 1.0, Placed(5.0, -3.0, 1.0, 0.0, 2.0, 1.0)), [1.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(find(2.0, 1.0, Placed(3.0, 1.5, 1.0, 0.0, 2.0, 1.0)), [0.0, 0.0], atol=1e-6)
