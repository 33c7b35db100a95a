"""Makes the banks of `study study=curriculum`: of generated towns, and of as many towns as there are logged scenes beside these.

python -m experiments.curriculum.make_banks --logged train.bank --out banks
"""

import argparse
import itertools
import operator
from pathlib import Path

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.parallel.task_map import open_pool
from scenefactory_jax.core.parallel.worker import FailedTask
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source


def main() -> None:
    """Writes OUT/town.bank and OUT/mixed.bank."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logged", type=Path, required=True, help="bank of logged scenes")
    parser.add_argument("--out", type=Path, required=True, help="folder of the new banks")
    parser.add_argument("--seed", type=int, default=0, help="of the generator; held-out towns have 2000000")
    parser.add_argument("--workers", type=int, default=8, help="processes that generate")
    options = parser.parse_args()
    scenes = hydra_config.load_config("train", "~experiment", "scenes=town")["scenes"]
    logged = bank_reader.open(options.logged)
    towns = scene_source.open_generator(scene_source.make_generator(scenes), seed=options.seed)
    with open_pool(options.workers) as task_map:
        generated = list(task_map(operator.call, [towns.read_one(index) for index in range(len(logged))]))
    if failed := [one for one in generated if isinstance(one, FailedTask)]:
        raise RuntimeError(f"{len(failed)} towns: {failed[0]}")
    settings = {"generate": scenes["generate"], "seed": options.seed}
    options.out.mkdir(parents=True, exist_ok=True)
    bank_reader.write(options.out / "town.bank", generated, settings=settings)
    both = itertools.chain(bank_reader.read_raws(logged, range(len(logged))), generated)
    bank_reader.write(options.out / "mixed.bank", both, settings=settings)


if __name__ == "__main__":
    main()
