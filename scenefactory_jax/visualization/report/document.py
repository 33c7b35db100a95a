"""Parts of Markdown reports: sections, pictures, links, and the file itself."""

import os
from pathlib import Path


def write(path: Path, *parts: str) -> Path:
    """Writes the parts that are not empty as paragraphs, and returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(join(*parts) + "\n", encoding="utf-8")
    return path


def join(*parts: str) -> str:
    """Joins the parts that are not empty as paragraphs."""
    return "\n\n".join(part for part in parts if part)


def section(title: str, *parts: str) -> str:
    """Formats a section; empty if all of its parts are."""
    body = join(*parts)
    return f"## {title}\n\n{body}" if body else ""


def fold(title: str, *parts: str) -> str:
    """Formats a section that is folded until its title is clicked; empty if all of its parts are."""
    body = join(*parts)
    return f"<details><summary>{title}</summary>\n\n{body}\n\n</details>" if body else ""


def picture(folder: Path, path: Path, caption: str) -> str:
    """Formats a picture with its caption, or a link to a film that Markdown cannot show."""
    link = relative(folder, path)
    return f"[{caption}]({link})" if path.suffix == ".mp4" else f"![{caption}]({link})\n\n*{caption}*"


def relative(folder: Path, path: Path) -> str:
    """Formats the link from a report in `folder` to a file, with blanks escaped."""
    return Path(os.path.relpath(path, folder)).as_posix().replace(" ", "%20")


def count(number: int, noun: str) -> str:
    """Formats a number of things: `1 seed`, `3 seeds`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
