"""Reads pickles of data: containers, numbers, texts and numpy arrays, and nothing else.

A pickle is a program for a stack machine. Even with a filtered `find_class`, `pickle.Unpickler` lets a hostile file change objects (BUILD),
allocate unlimited memory (LONG_BINPUT) and call hash functions. This module executes the few opcodes that data needs, over
`pickletools.genops`, and never calls anything in a file: a global is a name, and only the names in `GLOBALS` are accepted. Protocols 3 to
5, of numpy 1 and 2.
"""

import math
import pickletools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError
from scenefactory_jax.data.formats import file_content

PROTOCOLS = (3, 4, 5)
GLOBALS = {  # names in real files -> their meaning here; numpy._core of numpy 2 is numpy.core
    "numpy.core.multiarray._reconstruct": "array",
    "numpy.core.multiarray.scalar": "scalar",
    "numpy.core.numeric._frombuffer": "buffer",
    "numpy.ndarray": "type",
    "numpy.dtype": "dtype",
    "builtins.set": "set",
    "collections.OrderedDict": "dict",
    "collections.defaultdict": "dict",
    "builtins.int": "type",  # the factory of a defaultdict
    "builtins.float": "type",
    "builtins.list": "type",
    "builtins.dict": "type",
}
DTYPES = re.compile(r"[biuf][1248]|U\d{1,4}")  # numpy's codes of booleans, numbers and texts: no objects, no records
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
VALUES = {  # opcodes with their value as argument
    "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
LAST_CODE_POINT = 0x10FFFF  # of Unicode
MAX_DEPTH = 64  # of nested containers; those of a scenario are 7 deep
MAX_AXES = 32  # of an array; the product of many sizes takes long
SHARED = "expected at most one value per byte of the file, parts are shared over and over"
DAMAGE = (ValueError, IndexError, KeyError, TypeError, AttributeError, AssertionError, OverflowError)


@dataclass(frozen=True)
class _Global:
    """A name in a pickle, which cannot be called."""

    meaning: str


@dataclass
class _Dtype:
    """numpy's description of an array's elements; the byte order comes in a second step (BUILD)."""

    code: str
    order: str = "="


def load(path: Path, *, file_limit_mb: int, opcode_limit: int) -> Any:
    """Reads the value of a pickle.

    Args:
        path: of the file.
        file_limit_mb: larger contents are refused.
        opcode_limit: longer programs are refused; an opcode makes at most one object.

    Raises:
        FormatMismatch: not a pickle.
        SceneError: too large, damaged, cut short, or not plain data, naming the global or the opcode that is refused.
    """
    head = file_content.read_head(path)
    if len(head) < 2 or head[0] != 0x80 or head[1] not in PROTOCOLS:
        protocols = ", ".join(map(str, PROTOCOLS))
        raise FormatMismatch(f"{path}: expected a pickle of protocol {protocols}, got a file that begins with {head[:2]!r}")
    data = file_content.unpack(path, file_limit_mb=file_limit_mb)
    machine, place = _Machine(len(data)), 0
    try:
        for count, (opcode, argument, place) in enumerate(pickletools.genops(data)):  # noqa: B007
            if count >= opcode_limit:
                raise SceneError(f"more than {opcode_limit} opcodes; see opcode_limit")
            machine.execute(opcode.name, argument)
        (value,) = machine.stack
        if (size := _count_values(value, {}, 0)) > len(data):
            raise SceneError(f"{SHARED}: {size} values from {len(data)} bytes")
    except SceneError as refusal:
        raise SceneError(f"{path}: pickle, byte {place}: {refusal}") from None
    except DAMAGE as error:
        raise SceneError(f"{path}: not a valid pickle, damaged or cut short at byte {place} of {len(data)}: {error}") from error
    return value


class _Machine:
    """The stack machine."""

    def __init__(self, num_bytes: int):
        self.copies_left = num_bytes  # values and bytes that calls may still copy: a shared part is stored once, but each call copies it
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def execute(self, name: str, argument: Any) -> None:
        """Executes one opcode."""
        stack = self.stack
        if name in VALUES:
            if isinstance(argument, int) and argument.bit_length() > 64:
                raise SceneError(f"expected an integer of 64 bits, got an integer of {argument.bit_length()} bits")
            stack.append(argument)
        elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            self.memo[len(self.memo) if name == "MEMOIZE" else argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name in EMPTY:
            stack.append(EMPTY[name]())
        elif name == "MARK":
            self.marks.append(len(stack))
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self.pop_mark()
            _typed(stack[-1], list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else self.pop_mark()
            _typed(stack[-1], dict).update(zip(_hashable(items[::2]), items[1::2], strict=True))
        elif name == "ADDITEMS":
            items = self.pop_mark()
            _typed(stack[-1], set).update(_hashable(items))
        elif name == "TUPLE" or name in TUPLES:
            items = self.pop_mark() if name == "TUPLE" else [stack.pop() for _ in range(TUPLES[name])][::-1]
            stack.append(tuple(items))
        elif name == "GLOBAL":
            stack.append(_find(argument.replace(" ", ".", 1)))
        elif name == "STACK_GLOBAL":
            member, module = _typed(stack.pop(), str), _typed(stack.pop(), str)
            stack.append(_find(f"{module}.{member}"))
        elif name == "REDUCE":
            arguments, function = _typed(stack.pop(), tuple), _typed(stack.pop(), _Global)
            stack.append(self.reduce(function.meaning, arguments))
        elif name == "BUILD":
            state = _typed(stack.pop(), tuple)
            self.build(stack[-1], state)
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise SceneError(f"the opcode {name} is refused: plain data needs none of it")

    def pop_mark(self) -> list[Any]:
        """Removes and returns the values above the last mark."""
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def spend_copies(self, count: int) -> None:
        """Refuses to copy more than the size of the file."""
        self.copies_left -= count
        if self.copies_left < 0:
            raise SceneError(SHARED)

    def reduce(self, meaning: str, arguments: tuple[Any, ...]) -> Any:
        """The result of a call of a global."""
        if meaning == "array":
            return np.empty(0)  # BUILD fills it
        if meaning == "dtype":
            return _Dtype(_typed(arguments[0], str))
        if meaning == "scalar":
            return self.array((), arguments[0], "C", arguments[1]).item()
        if meaning == "buffer":
            raw, dtype, shape, order = arguments
            return self.array(shape, dtype, order, raw)
        if meaning == "set":
            items = _typed(arguments[0], list) if arguments else []
            self.spend_copies(len(items))
            return set(_hashable(items))
        if meaning == "dict":
            return {}
        raise SceneError(f"a call of the global {meaning!r} is refused")

    def build(self, target: Any, state: tuple[Any, ...]) -> None:
        """Completes a dtype or an array of numpy's pickles."""
        if isinstance(target, _Dtype):
            _, target.order, _, names, fields, *_ = state
            if target.order not in ("<", ">", "|", "=") or names is not None or fields is not None:
                raise SceneError("a dtype of records or of an unknown byte order is refused")
        elif isinstance(target, np.ndarray):
            _, shape, dtype, fortran, raw = state
            array = self.array(shape, dtype, "F" if fortran else "C", raw)
            target.__setstate__((1, array.shape, array.dtype, bool(fortran), bytes(raw)))  # pyright: ignore[reportArgumentType]
        else:
            raise SceneError(f"the opcode BUILD on {type(target).__name__} is refused")

    def array(self, shape: Any, dtype: Any, order: Any, raw: Any) -> np.ndarray:
        """An array from its bytes, whose number must be that of its shape."""
        description = _typed(dtype, _Dtype)
        if not DTYPES.fullmatch(description.code):
            raise SceneError(f"expected an array of booleans, numbers or texts, got {description.code!r}")
        if not isinstance(raw, (bytes, bytearray)):
            raise SceneError(f"expected the bytes of an array, got {type(raw).__name__}")
        kind = np.dtype(description.order + description.code)
        if len(_typed(shape, tuple)) > MAX_AXES or any(_typed(size, int) < 0 for size in shape):
            raise SceneError(f"expected at most {MAX_AXES} sizes of 0 or more, got an array of the shape {shape[:MAX_AXES]}")
        if (size := math.prod(shape) * kind.itemsize) != len(raw):
            raise SceneError(f"expected {size} bytes for an array of the shape {shape}, got {len(raw)}")
        self.spend_copies(len(raw))
        if kind.kind == "U":  # numpy keeps code points beyond Unicode, and Python's texts fail on them later
            codes = np.frombuffer(raw, f"{description.order}u4")
            if (bad := codes[codes > LAST_CODE_POINT]).size:
                raise SceneError(f"expected code points up to {LAST_CODE_POINT:#x} in a text, got the code point {bad[0]:#x}")
        return np.ndarray(shape, kind, buffer=raw if raw else None, order="F" if order == "F" else "C")


def _typed(value: Any, kind: type) -> Any:
    """`value`, if its type is exactly that."""
    if type(value) is not kind:
        raise TypeError(f"expected {kind.__name__}, got {type(value).__name__}")
    return value


def _hashable(keys: list[Any]) -> list[Any]:
    """Keys of a dict or a set, if they are texts or numbers; the hash of nested values may exhaust the C stack."""
    if bad := [key for key in keys if not isinstance(key, (str, int, float, type(None)))]:
        raise SceneError(f"expected texts and numbers as keys, got a {type(bad[0]).__name__} as a key")
    return keys


def _find(name: str) -> _Global:
    """The meaning of a global."""
    known = name.replace("numpy._core.", "numpy.core.", 1)
    if known not in GLOBALS:
        raise SceneError(f"the global {name} is refused; expected one of {', '.join(GLOBALS)}")
    return _Global(GLOBALS[known])


def _count_values(value: Any, sizes: dict[int, int], depth: int) -> int:
    """The number of values in a value; parts that are shared count each time. `sizes` holds those of containers by their id."""
    if isinstance(value, np.ndarray):
        return value.size
    if not isinstance(value, (list, tuple, dict, set)) or not value:
        return 1
    if id(value) not in sizes:
        if depth > MAX_DEPTH:
            raise SceneError(f"containers nested deeper than {MAX_DEPTH}, or in themselves")
        parts = [*value.keys(), *value.values()] if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_count_values(part, sizes, depth + 1) for part in parts)
    return sizes[id(value)]
