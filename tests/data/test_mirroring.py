"""Mirror images of scenes: a law, the sides of edges and neighbours, and the operation that writes them."""

import numpy as np
import pytest
from support.scene_banks import banked, generated

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.core.types import DRIVABLE, EDGES
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.curation.mirroring import mirror


@pytest.fixture(scope="module")
def town():
    return generated(3)


def find_side(point, line):
    """On which side of a line's nearest segment a point is: 1 left, -1 right."""
    middles, along = (line[1:] + line[:-1])[:, :2] / 2, np.diff(line, axis=0)[:, :2]
    nearest = np.argmin(np.hypot(*(middles - point[:2]).T))
    away = point[:2] - middles[nearest]
    return np.sign(along[nearest, 0] * away[1] - along[nearest, 1] * away[0])


def test_a_mirror_image_of_a_mirror_image_is_the_scene(town):
    twice = mirror(mirror(town))
    assert twice.name == f"{town.name}-mirrored-mirrored" and twice.origin == town.origin
    for one, other in zip(twice.roads, town.roads, strict=True):
        np.testing.assert_array_equal(one.xyz, other.xyz)
        assert (one.left, one.right, one.entry, one.exit) == (other.left, other.right, other.entry, other.exit)
    for one, other in zip(twice.tracks, town.tracks, strict=True):
        for name in ("xyz", "yaw", "velocity", "valid"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_roads_stay_on_their_side_of_edges_and_neighbours_change_sides(town):
    mirrored = mirror(town)
    lanes = [index for index, line in enumerate(town.roads) if line.kind in DRIVABLE and len(line.xyz) > 1]
    edges = [index for index, line in enumerate(town.roads) if line.kind in EDGES]

    def find_edge_side(scene, lane):
        middle = scene.roads[lane].xyz[len(scene.roads[lane].xyz) // 2]
        nearest = min(edges, key=lambda edge: np.hypot(*(scene.roads[edge].xyz - middle)[:, :2].T).min())
        return find_side(middle, scene.roads[nearest].xyz)

    sides = [[find_edge_side(scene, lane) for lane in lanes] for scene in (town, mirrored)]
    assert np.mean(sides[0]) > 0.5  # the road is to the left of an edge
    assert sides[0] == sides[1]

    place = {line.id: index for index, line in enumerate(mirrored.roads)}
    beside = [(lane, place[other]) for lane in lanes for other in mirrored.roads[lane].left]
    assert beside and [tuple(line.left) for line in mirrored.roads] == [tuple(line.right) for line in town.roads]
    for lane, other in beside:
        middle = mirrored.roads[other].xyz[len(mirrored.roads[other].xyz) // 2]
        assert find_side(middle, mirrored.roads[lane].xyz) == 1
    for one, other in zip(town.tracks, mirrored.tracks, strict=True):
        np.testing.assert_allclose(np.sin(one.yaw), -np.sin(other.yaw), atol=1e-12)


def test_the_operation_writes_each_scene_also_as_its_mirror_image(town, tmp_path):
    bank = banked(tmp_path / "one", [town])
    overrides = ["op=egos", "egos.count=1", "egos.mirrored=true", f"out={tmp_path / 'egos'}", "progress=false"]
    written = scenes(hydra_config.load_config("scenes", f"scenes.path={bank.path}", *overrides))
    names = list(written.names)
    assert len(names) == 4 and {f"{name}-mirrored" for name in names[::2]} == set(names[1::2])
    first, image = list(banks.read_raws(written, range(2)))
    np.testing.assert_allclose(image.tracks[0].xyz[:, 1], -first.tracks[0].xyz[:, 1])
