"""Ids that are texts in a source and integers here."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

NUMBER = re.compile(r"0|-?[1-9]\d{0,17}")  # a text that an integer of 64 bits gives back as it is


def assign_ids(keys: Iterable[Any]) -> dict[str, int]:
    """Keys -> ids: a number stays what it is, anything else is counted on after the largest, in the keys' order."""
    texts = list(dict.fromkeys(map(str, keys)))
    numbers = {text: int(text) for text in texts if NUMBER.fullmatch(text)}
    start = max(numbers.values(), default=-1) + 1
    tokens = [text for text in texts if text not in numbers]
    return numbers | {token: start + place for place, token in enumerate(tokens)}


def look_up_id(key: Any, ids: Mapping[str, int]) -> int | None:
    """The id of what a key names; a number that is not among them stays, as in a map that was cut out of a larger one."""
    text = str(key)
    return ids[text] if text in ids else int(text) if NUMBER.fullmatch(text) else None


def list_tokens(ids: Mapping[str, int]) -> dict[str, int]:
    """Those keys that are no numbers, with what stands for them."""
    return {text: identity for text, identity in ids.items() if text != str(identity)}
