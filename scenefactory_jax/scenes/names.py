"""Names that a source made up, where they must be plain: as the name of a file, and on a terminal."""

import re


def for_file(name: str) -> str:
    """A name that stays within its folder, whatever was in it."""
    return re.sub(r"[^\w.-]", "_", name)


def for_terminal(text: str) -> str:
    """Text that can be printed: half a surrogate pair, which JSON may hold, is spelled out."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
