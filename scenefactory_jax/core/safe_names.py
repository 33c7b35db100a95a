"""Makes names from data safe as file names and on a terminal."""

import re
import unicodedata


def to_file_name(name: str) -> str:
    """Returns a file name without path separators or special characters."""
    return re.sub(r"[^\w.-]", "_", name)


def escape_for_terminal(text: str) -> str:
    """Escapes characters that control a terminal or cannot be shown: line ends, and the Unicode categories control, format (writing
    direction), surrogate, private and unassigned.
    """
    spelled = lambda char: unicodedata.category(char) in ("Zl", "Zp") or unicodedata.category(char)[0] == "C"  # noqa: E731
    return "".join(char.encode("unicode_escape").decode() if spelled(char) else char for char in text)
