"""Runs in several processes: shares values and a signal, then ends as it is told.

    python -m support.processes COORDINATOR PROCESSES INDEX fail|kill|wait|stop
"""

import os
import signal
import sys
import time

from scenefactory_jax.core import distributed

LIMIT_S = 6.0  # a busy machine may stop a process for seconds


def main(coordinator: str, processes: int, index: int, end: str) -> None:
    last = index == processes - 1
    settings = distributed.Distributed(
        enable=True, coordinator=coordinator, processes=processes, process=index, start_s=5.0 if end == "wait" else 60.0, timeout_s=LIMIT_S
    )
    with distributed.join(settings):
        assert distributed.is_first() == (index == 0)
        assert distributed.share("name", lambda: [index, "of the first"]) == [0, "of the first"]
        assert distributed.share_stop(1, late=False, signal=None) == (False, None)
        for iteration in range(2, 1000):  # the first process may have decided before the signal came to it
            distributed.STATE.client.wait_at_barrier(f"iteration {iteration}", 60_000)  # as its sums over all devices
            late, stop = distributed.share_stop(iteration, late=index > 0, signal=signal.SIGTERM if last else None)
            if stop:
                break
        assert (late, stop) == (False, signal.SIGTERM) and distributed.share("after", lambda: iteration) == iteration
        print("shared", flush=True)
        if end == "stop":
            raise KeyboardInterrupt(signal.SIGTERM)
        if last and end == "fail":
            raise OSError(28, "No space left on device", "metrics.csv")
        if last and end == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60.0)


if __name__ == "__main__":
    address, count, place, way = sys.argv[1:]
    try:
        main(address, int(count), int(place), way)
    except (KeyboardInterrupt, distributed.ConfigError, OSError) as error:
        print(f"ended: {error}", flush=True)
        sys.exit(3)
