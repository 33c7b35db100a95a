"""What loading alone gives: scenes per second of a stream in whose worlds nothing drives, and what this process pays for each.

python -m experiments.benchmarks.loading experiment=generalist stream=shuffled stream.workers=1 worlds=64 [scenes=womd scenes.path=BANK]

The stream is that of a training. `stream.shares=null` in place of a mixture streams `scenes` alone.
"""

import json
import os
import time
from collections.abc import Mapping
from typing import Any

from scenefactory_jax.cli import entry
from scenefactory_jax.data.loading import stream


def measure(config: Mapping[str, Any]) -> dict[str, Any]:
    """Exchanges scenes without a pause: `repeats` times after `warmup` times."""
    with stream.open_stream(config, mesh=None, before=None) as flow:
        scenes = flow.scenes()

        def exchange(times: int) -> None:
            nonlocal scenes
            for _ in range(times):
                _, scenes = flow.exchange(lambda state, held, worlds, fresh: (state, held), None, scenes)
                flow.draw()

        exchange(config["warmup"])
        begun, used = time.perf_counter(), time.process_time()
        exchange(config["repeats"])
        seconds, used, count = time.perf_counter() - begun, time.process_time() - used, config["repeats"] * flow.swapped
    return {
        "scenes": count,
        "workers": config["stream"]["workers"],
        "cores": os.cpu_count(),
        "scenes_per_s": round(count / seconds, 2),
        "ms_of_this_process_a_scene": round(1e3 * used / count, 2),  # on its processor: receiving, stacking, placing
    }


def run(config: Mapping[str, Any]) -> None:
    """Measures and prints a line of JSON."""
    print(json.dumps(measure(config)))


if __name__ == "__main__":
    entry.run("benchmark", run, about="measure how many scenes per second a stream loads")
