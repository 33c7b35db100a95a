"""Reads pickles of data: containers, numbers, texts and numpy arrays, and nothing else.

A pickle is a program for a stack machine. Even with a filtered `find_class`, `pickle.Unpickler` lets a hostile file change objects (BUILD),
allocate unlimited memory (LONG_BINPUT) and call hash functions. This module executes the few opcodes that data needs, over
`pickletools.genops`, and never calls anything in a file: a global is a name, and only the names in `GLOBALS` are accepted. Protocols 3 to
5, of numpy 1 and 2.
"""

import pickletools
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError

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

    def numpy(self) -> np.dtype:
        if not DTYPES.fullmatch(self.code):
            raise SceneError(f"expected an array of booleans, numbers or texts, got {self.code!r}")
        return np.dtype(self.order + self.code)


@dataclass
class _Machine:
    """The state of the stack machine."""

    copies_left: int  # values and bytes that calls may still copy; one for each byte of the file at the start
    stack: list[Any] = field(default_factory=list)
    marks: list[int] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)

    def spend_copies(self, count: int) -> None:
        """Refuses to copy more than the size of the file: a shared part is stored once, but each call copies it."""
        self.copies_left -= count
        if self.copies_left < 0:
            raise SceneError(SHARED)

    def pop_mark(self) -> list[Any]:
        """Removes and returns the values above the last mark."""
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items


def load(path: Path, *, file_limit_mb: int, opcode_limit: int) -> Any:
    """Reads the value of a pickle.

    Args:
        path: of the file.
        file_limit_mb: larger files are refused unread.
        opcode_limit: longer programs are refused; an opcode makes at most one object.

    Raises:
        FormatMismatch: not a pickle.
        SceneError: too large, damaged, cut short, or not plain data, naming the global or the opcode that is refused.
    """
    data = _read(path, file_limit_mb)
    machine, place = _Machine(len(data)), 0
    try:
        for count, (opcode, argument, place) in enumerate(pickletools.genops(data)):  # noqa: B007
            if count >= opcode_limit:
                raise SceneError(f"more than {opcode_limit} opcodes; see opcode_limit")
            _execute(machine, opcode.name, argument)
        (value,) = machine.stack
        _check_size(value, len(data))
    except SceneError as refusal:
        raise SceneError(f"{path}: pickle, byte {place}: {refusal}") from None
    except DAMAGE as error:
        raise SceneError(f"{path}: not a valid pickle, damaged or cut short at byte {place} of {len(data)}: {error}") from error
    return value


def _read(path: Path, file_limit_mb: int) -> bytes:
    """Reads a file that begins as a pickle."""
    try:
        with open(path, "rb") as file:
            start = file.read(2)
            if len(start) < 2 or start[0] != 0x80 or start[1] not in PROTOCOLS:
                protocols = ", ".join(map(str, PROTOCOLS))
                raise FormatMismatch(f"{path}: expected a pickle of protocol {protocols}, got a file that begins with {start!r}")
            if (size_mb := Path(path).stat().st_size / 1e6) > file_limit_mb:
                raise SceneError(f"{path}: a pickle of {size_mb:.0f} MB; file_limit_mb is {file_limit_mb}")
            return start + file.read()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error


def _execute(machine: _Machine, name: str, argument: Any) -> None:
    """Executes one opcode."""
    stack = machine.stack
    if name in VALUES:
        if isinstance(argument, int) and argument.bit_length() > 64:
            raise SceneError(f"expected an integer of 64 bits, got an integer of {argument.bit_length()} bits")
        stack.append(argument)
    elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
        machine.memo[len(machine.memo) if name == "MEMOIZE" else argument] = stack[-1]
    elif name in ("BINGET", "LONG_BINGET"):
        stack.append(machine.memo[argument])
    elif name in CONSTANTS:
        stack.append(CONSTANTS[name])
    elif name in EMPTY:
        stack.append(EMPTY[name]())
    elif name == "MARK":
        machine.marks.append(len(stack))
    elif name in ("APPEND", "APPENDS"):
        items = [stack.pop()] if name == "APPEND" else machine.pop_mark()
        _typed(stack[-1], list).extend(items)
    elif name in ("SETITEM", "SETITEMS"):
        items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else machine.pop_mark()
        _typed(stack[-1], dict).update(zip(_hashable(items[::2]), items[1::2], strict=True))
    elif name == "ADDITEMS":
        items = machine.pop_mark()
        _typed(stack[-1], set).update(_hashable(items))
    elif name == "TUPLE":
        stack.append(tuple(machine.pop_mark()))
    elif name in TUPLES:
        items = [stack.pop() for _ in range(TUPLES[name])]
        stack.append(tuple(reversed(items)))
    elif name == "GLOBAL":
        stack.append(_find(argument.replace(" ", ".", 1)))
    elif name == "STACK_GLOBAL":
        member, module = _typed(stack.pop(), str), _typed(stack.pop(), str)
        stack.append(_find(f"{module}.{member}"))
    elif name == "REDUCE":
        arguments, function = _typed(stack.pop(), tuple), _typed(stack.pop(), _Global)
        stack.append(_reduce(machine, function.meaning, arguments))
    elif name == "BUILD":
        state = _typed(stack.pop(), tuple)
        _build(machine, stack[-1], state)
    elif name not in ("PROTO", "FRAME", "STOP"):
        raise SceneError(f"the opcode {name} is refused: plain data needs none of it")


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


def _reduce(machine: _Machine, meaning: str, arguments: tuple[Any, ...]) -> Any:
    """The result of a call of a global."""
    if meaning == "array":
        return np.empty(0)  # BUILD fills it
    if meaning == "dtype":
        return _Dtype(_typed(arguments[0], str))
    if meaning == "scalar":
        return _array(machine, (), _typed(arguments[0], _Dtype), "C", arguments[1]).item()
    if meaning == "buffer":
        raw, dtype, shape, order = arguments
        return _array(machine, shape, _typed(dtype, _Dtype), order, raw)
    if meaning == "set":
        items = _typed(arguments[0], list) if arguments else []
        machine.spend_copies(len(items))
        return set(_hashable(items))
    if meaning == "dict":
        return {}
    raise SceneError(f"a call of the global {meaning!r} is refused")


def _build(machine: _Machine, target: Any, state: tuple[Any, ...]) -> None:
    """Completes a dtype or an array of numpy's pickles."""
    if isinstance(target, _Dtype):
        _, target.order, _, names, fields, *_ = state
        if target.order not in ("<", ">", "|", "=") or names is not None or fields is not None:
            raise SceneError("a dtype of records or of an unknown byte order is refused")
    elif isinstance(target, np.ndarray):
        _, shape, dtype, fortran, raw = state
        filled = _array(machine, shape, _typed(dtype, _Dtype), "F" if fortran else "C", raw)
        target.__setstate__((1, filled.shape, filled.dtype, bool(fortran), bytes(raw)))  # pyright: ignore[reportArgumentType]
    else:
        raise SceneError(f"the opcode BUILD on {type(target).__name__} is refused")


def _array(machine: _Machine, shape: Any, dtype: _Dtype, order: Any, raw: Any) -> np.ndarray:
    """An array from its bytes, whose number must be that of its shape."""
    kind = dtype.numpy()
    if not isinstance(raw, (bytes, bytearray)):
        raise SceneError(f"expected the bytes of an array, got {type(raw).__name__}")
    count = 1
    for size in _typed(shape, tuple):
        if _typed(size, int) < 0:
            raise SceneError(f"expected sizes of 0 or more, got an array of the shape {shape}")
        count *= size
    if count * kind.itemsize != len(raw):
        raise SceneError(f"expected {count * kind.itemsize} bytes for an array of the shape {shape}, got {len(raw)}")
    machine.spend_copies(len(raw))
    if kind.kind == "U":
        _check_characters(np.frombuffer(raw, f"{dtype.order}u4"))
    return np.ndarray(shape, kind, buffer=raw if raw else None, order="F" if order == "F" else "C")


def _check_characters(codes: np.ndarray) -> None:
    """Refuses code points beyond Unicode: numpy would keep them, and Python's texts fail on them later."""
    if (bad := codes[codes > LAST_CODE_POINT]).size:
        raise SceneError(f"expected code points up to {LAST_CODE_POINT:#x} in a text, got the code point {bad[0]:#x}")


def _check_size(value: Any, limit: int) -> None:
    """Refuses data with more values than the file has bytes: parts that are shared very often make it a bomb for any reader."""
    sizes: dict[int, int] = {}

    def size(value: Any, depth: int) -> int:
        if isinstance(value, np.ndarray):
            return value.size
        if not isinstance(value, (list, tuple, dict, set)) or not value:
            return 1
        if id(value) not in sizes:
            if depth > MAX_DEPTH:
                raise SceneError(f"containers nested deeper than {MAX_DEPTH}, or in themselves")
            parts = [*value.keys(), *value.values()] if isinstance(value, dict) else value
            sizes[id(value)] = 1 + sum(size(part, depth + 1) for part in parts)
        return sizes[id(value)]

    if (found := size(value, 0)) > limit:
        raise SceneError(f"{SHARED}: {found} values from {limit} bytes")
