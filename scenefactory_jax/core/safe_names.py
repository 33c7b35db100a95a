"""Names that a source made up, where they must be plain: as the name of a file, and on a terminal."""

import re
import unicodedata


def to_file_name(name: str) -> str:
    """A name that stays within its folder, whatever was in it."""
    return re.sub(r"[^\w.-]", "_", name)


def escape_for_terminal(text: str) -> str:
    """A line that can be printed: what a terminal would obey or cannot show is spelled out.

    That is what Unicode counts as control, format (which turns the direction of writing), half a surrogate pair (which JSON may hold),
    private or unassigned, and every end of a line.
    """
    spelled = lambda char: unicodedata.category(char) in ("Zl", "Zp") or unicodedata.category(char)[0] == "C"  # noqa: E731
    return "".join(char.encode("unicode_escape").decode() if spelled(char) else char for char in text)
