"""Commands. What the library logs is printed, unless the program has set up logging for `scenefactory_jax` itself."""

import logging


class Console(logging.Handler):
    """Prints messages as they are."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), flush=True)


LOG = logging.getLogger("scenefactory_jax")
if not LOG.handlers:
    LOG.addHandler(Console())
    LOG.setLevel(logging.INFO)
