"""What the pages of README and docs tell a reader to type."""

import re
import shlex


def commands(page):
    """The words of every line of a page that calls the package, its command first, as a shell divides them."""
    for call in re.findall(r"^python -m scenefactory_jax (.+)$", page.read_text(), re.MULTILINE):
        yield shlex.split(call, comments=True)
