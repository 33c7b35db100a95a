"""Formats that no reader reads, told by how a file begins, so that a refusal can name them."""

import re

HEAD = 16_384  # bytes that are looked at: SUMO's networks begin with a comment of some thousand
STARTS = {
    b"SQLite format 3\0": "an SQLite database, such as nuPlan's logs",
    b"\x89HDF": "HDF5",
    b"PK\x03\x04": "a ZIP archive",
    b"BZh": "a file compressed by bzip2",
    b"\x28\xb5\x2f\xfd": "a file compressed by Zstandard",
    b"track_id,frame_id,timestamp_ms,": "a recording of INTERACTION (CSV)",
}
ROOTS = {
    "OpenDRIVE": "OpenDRIVE",
    "OpenSCENARIO": "OpenSCENARIO",
    "commonRoad": "CommonRoad",
    "osm": "OpenStreetMap XML, such as the Lanelet2 maps of INTERACTION",
    "net": "a network of SUMO",
    "routes": "routes of SUMO",
    "additional": "additional elements of SUMO",
    "sumoConfiguration": "a configuration of SUMO",
}
BEFORE_ROOT = re.compile(r"<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>", re.DOTALL)  # declaration, comments and document type


def find_name(head: bytes) -> str | None:
    """The name of the format of a file that begins so, with an article where it needs one; None if it cannot be told."""
    for start, name in STARTS.items():
        if head.startswith(start):
            return name
    text = head.decode("utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig", errors="ignore").lstrip()
    root = re.match(r"<(?:\w+:)?([\w.-]+)", BEFORE_ROOT.sub("", text).lstrip()) if text.startswith("<") else None
    if root is None:
        return None
    return ROOTS.get(root[1], f"XML of the root element {root[1][:40]!r}")
