"""`export`: what a run's policy learnt, as a small folder to hand on."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.build import ConfigError
from scenefactory_jax.ppo import checkpoint
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, policies


def export(config: Mapping[str, Any]) -> Path:
    """Write the policy's numbers, the run's config and the versions it was made with (`load("export", "run=...", "out=...")`).

    The folder stands for the run wherever a policy is wanted (`evaluate`, `replay`, `drive`, `sf.load_policy`); training cannot go on from
    it.

    Raises:
        ConfigError: no such run, no checkpoint in it, or a folder that holds something.
    """
    keys.check(config, keys.HANDING_ON)
    out = Path(config["out"])
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"out: {out} holds something already; give a new folder")
    trained = policies.load_policy(config["run"])
    (out / "checkpoints").mkdir(parents=True)
    file = checkpoint.write_parameters(out / "checkpoints", trained.parameters)
    own = trained.config
    # where scenes lay is of no use elsewhere, and nobody else's business
    scenes = {**own["scenes"], "path": None, "heldout": {**own["scenes"]["heldout"], "path": None}}
    configs.write(out, {**own, "out": None, "resume": False, "scenes": scenes})
    shutil.copy(trained.folder / "versions.yaml", out)
    print(f"{out}: {file.stat().st_size / 1e6:.2f} MB", flush=True)
    return out
