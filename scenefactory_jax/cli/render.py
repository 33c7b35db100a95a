"""`render`: one scene as a MuJoCo model with all its cars, as XML, and as pictures."""
# pyright: reportAttributeAccessIssue=false
# mujoco is an extension module without stubs

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from scenefactory_jax.cli.scenes import draw
from scenefactory_jax.cli.view_schema import Render
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.visualization.mujoco import offscreen_renderer, world_mjcf
from scenefactory_jax.weather import road_condition


def render(config: Mapping[str, Any]) -> Path:
    """Write `scene.xml` (open it with `python -m mujoco.viewer --mjcf=...`), a bird's-eye picture and MuJoCo's own view to `out`.

    The bird's-eye picture shows the patches of one draw of the weather.

    Raises:
        ConfigError: no such scene, or a dynamics without a car to show.
        SceneError: nothing usable at the path.
    """
    schema.check(config, Render)
    loaded = scene_source.load_training_scenes(config["scenes"])
    index, count = config["index"], len(loaded)
    if not 0 <= index < count:
        raise ConfigError(f"index: {index}; valid: 0 to {count - 1}")
    scene = jax.tree.map(lambda leaf: np.asarray(leaf[index]), loaded.scene)
    context = {"control_dt": 1.0 / config["timing"]["control_hz"]}
    who = instantiate(config["traffic"], builtins="scenefactory_jax.env.traffic", where="traffic", **context)
    scene = replace(scene, traffic=who(jax.tree.map(jnp.asarray, scene), jnp.int32(0)))
    spec = world(config, scene)
    out = Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    xml = out / "scene.xml"
    xml.write_text(spec.to_xml())
    print(f"{loaded.names[index]}: {xml}", flush=True)
    weather = jax.jit(road_condition.make(config["weather"]))(jax.random.key(config["seed"]), scene)
    drawn = replace(scene, weather=jax.device_get(weather))
    one = scene_source.Scenes(jax.tree.map(lambda leaf: leaf[None], drawn), (loaded.names[index],), loaded.account)
    print(draw(one, out, limit=1)[0], flush=True)
    try:
        imageio.imwrite(out / "mujoco.png", photograph(spec.compile(), **config["image"]))
        print(out / "mujoco.png", flush=True)
    except offscreen_renderer.OpenGLError as error:  # the files above are there all the same
        print(error, flush=True)
    return xml


def world(config: Mapping[str, Any], scene: Scene) -> mujoco.MjSpec:
    """The whole scene with its cars and their tyre contacts, as a spec that compiles and steps.

    Raises:
        ConfigError: the configured dynamics has no articulated car.
    """
    dynamics = config["dynamics"]
    if "car" not in dynamics or "solver" not in dynamics:
        raise ConfigError(f"dynamics: {dynamics['_target_']} has no car to show; valid: articulated, articulated_paper, mjx")
    parameters, solver = cars.read_parameters(dynamics)
    car = models.build_mjspec(parameters, visual=True, brake_rows=False)
    spec = world_mjcf.world(scene, car, scene_size_m=config["scenes"]["pack"]["scene_size_m"], **config["world"])
    for slot in np.flatnonzero(np.asarray(scene.agents.present)):
        models.add_ground_pairs(spec, parameters, ground="ground", prefix=f"agent{slot}/")
    models.set_options(spec, solver, physics_dt=1.0 / config["timing"]["physics_hz"])
    return spec


def photograph(model: mujoco.MjModel, *, width: int, height: int) -> np.ndarray:
    """The world from above and behind, by MuJoCo's renderer.

    Raises:
        OpenGLError: nothing here to draw with; the message says what to install or set.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = model.stat.center, 1.1 * model.stat.extent, 90.0, -50.0
    with offscreen_renderer.make_painter(model, data, width=width, height=height) as paint:
        return paint(camera, lambda scene: None)
