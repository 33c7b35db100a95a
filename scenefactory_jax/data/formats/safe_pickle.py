"""Pickles read as data: the containers, numbers, texts and numpy arrays in them, and nothing else.

A pickle is a program for a stack machine. Even with a filtered `find_class`, `pickle.Unpickler` lets a hostile file change what it is given
(BUILD), ask for memory without end (LONG_BINPUT) and hash what it likes. So the few opcodes that data needs are carried out here, over
`pickletools.genops`, and nothing in a file is ever called: a global is a name, and only the names in `GLOBALS` mean something. Protocols 3
to 5, of numpy 1 and 2.
"""

import pickletools
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError
from scenefactory_jax.data.formats.json_documents import is_number

PROTOCOLS = (3, 4, 5)
GLOBALS = {  # names that real files use -> what stands for them here; numpy 2 says numpy._core for numpy.core
    "numpy.core.multiarray._reconstruct": "array",
    "numpy.core.multiarray.scalar": "scalar",
    "numpy.core.numeric._frombuffer": "buffer",
    "numpy.ndarray": "type",
    "numpy.dtype": "dtype",
    "builtins.set": "set",
    "collections.OrderedDict": "dict",
    "collections.defaultdict": "dict",
    "builtins.int": "type",  # what a defaultdict makes of a missing key
    "builtins.float": "type",
    "builtins.list": "type",
    "builtins.dict": "type",
}
DTYPES = re.compile(r"[biuf][1248]|U\d{1,4}")  # numpy's codes of truth values, numbers and texts: no objects, no records
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
VALUES = {  # opcodes that hold their value
    "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
LAST_CODE_POINT = 0x10FFFF  # of Unicode
DEPTH = 64  # of containers in containers; a scenario's are 7 deep
SHARED = "parts that are shared over and over are refused"
DAMAGE = (ValueError, IndexError, KeyError, TypeError, AttributeError, AssertionError, OverflowError)


@dataclass(frozen=True)
class _Global:
    """A name in a pickle. It cannot be called."""

    meaning: str


@dataclass
class _Dtype:
    """numpy's description of an array's elements; the byte order comes in a second step (BUILD)."""

    code: str
    order: str = "="

    def numpy(self) -> np.dtype:
        if not DTYPES.fullmatch(self.code):
            raise SceneError(f"an array of {self.code!r}; valid: truth values, numbers and texts")
        return np.dtype(self.order + self.code)


@dataclass
class _Machine:
    """The state of the stack machine."""

    copies_left: int  # values and bytes that calls may still copy: each byte of the file is worth one
    stack: list[Any] = field(default_factory=list)
    marks: list[int] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)

    def spend_copies(self, count: int) -> None:
        """Refuse to copy more than the file holds: a part that is shared is stored once, but a call copies it each time."""
        self.copies_left -= count
        if self.copies_left < 0:
            raise SceneError(SHARED)

    def since_mark(self) -> list[Any]:
        """What lies above the last mark, taken off."""
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items


def load(path: Path, *, file_limit_mb: int, opcode_limit: int) -> Any:
    """What a pickle holds.

    Args:
        path: of the file.
        file_limit_mb: larger files are refused unread.
        opcode_limit: longer programs are refused; an opcode makes one object at most.

    Raises:
        FormatMismatch: no pickle.
        SceneError: too large, damaged, cut short, or more than data, naming the global or the opcode that was refused.
    """
    data = _content(path, file_limit_mb)
    machine, place = _Machine(len(data)), 0
    try:
        for count, (opcode, argument, place) in enumerate(pickletools.genops(data)):  # noqa: B007
            if count >= opcode_limit:
                raise SceneError(f"more than {opcode_limit} opcodes; set opcode_limit to read it nevertheless")
            _execute(machine, opcode.name, argument)
        (whole,) = machine.stack
        _require_own_size(whole, len(data))
    except SceneError as refusal:
        raise SceneError(f"{path}: pickle, byte {place}: {refusal}") from None
    except DAMAGE as error:
        raise SceneError(f"{path}: no valid pickle, damaged or cut short at byte {place} of {len(data)}: {error}") from error
    return whole


def _content(path: Path, file_limit_mb: int) -> bytes:
    """The bytes of a file that begins as a pickle."""
    try:
        with open(path, "rb") as file:
            start = file.read(2)
            if len(start) < 2 or start[0] != 0x80 or start[1] not in PROTOCOLS:
                raise FormatMismatch(f"{path}: no pickle of protocol {', '.join(map(str, PROTOCOLS))}; it begins with {start!r}")
            if (size_mb := Path(path).stat().st_size / 1e6) > file_limit_mb:
                raise SceneError(f"{path}: a pickle of {size_mb:.0f} MB; file_limit_mb is {file_limit_mb}")
            return start + file.read()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error


def _execute(machine: _Machine, name: str, argument: Any) -> None:
    """One opcode."""
    stack = machine.stack
    if name in VALUES:
        if isinstance(argument, int) and argument.bit_length() > 64:
            raise SceneError(f"an integer of {argument.bit_length()} bits; valid: 64")
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
        items = [stack.pop()] if name == "APPEND" else machine.since_mark()
        _of(stack[-1], list).extend(items)
    elif name in ("SETITEM", "SETITEMS"):
        items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else machine.since_mark()
        _of(stack[-1], dict).update(zip(_plain(items[::2]), items[1::2], strict=True))
    elif name == "ADDITEMS":
        items = machine.since_mark()
        _of(stack[-1], set).update(_plain(items))
    elif name == "TUPLE":
        stack.append(tuple(machine.since_mark()))
    elif name in TUPLES:
        items = [stack.pop() for _ in range(TUPLES[name])]
        stack.append(tuple(reversed(items)))
    elif name == "GLOBAL":
        stack.append(_find(argument.replace(" ", ".", 1)))
    elif name == "STACK_GLOBAL":
        member, module = _of(stack.pop(), str), _of(stack.pop(), str)
        stack.append(_find(f"{module}.{member}"))
    elif name == "REDUCE":
        arguments, function = _of(stack.pop(), tuple), _of(stack.pop(), _Global)
        stack.append(_reduce(machine, function.meaning, arguments))
    elif name == "BUILD":
        state = _of(stack.pop(), tuple)
        _build(machine, stack[-1], state)
    elif name not in ("PROTO", "FRAME", "STOP"):
        raise SceneError(f"the opcode {name} is refused: plain data needs none of it")


def _of(value: Any, kind: type) -> Any:
    """`value`, if it is of exactly that type."""
    if type(value) is not kind:
        raise TypeError(f"{type(value).__name__} where {kind.__name__} is needed")
    return value


def _plain(keys: Iterable[Any]) -> list[Any]:
    """Keys of a dict or a set, if they are texts or numbers; to hash anything deeper may exhaust the C stack."""
    keys = list(keys)
    if bad := [key for key in keys if not isinstance(key, (str, int, float, type(None)))]:
        raise SceneError(f"a {type(bad[0]).__name__} as a key; valid: texts and numbers")
    return keys


def _find(name: str) -> _Global:
    """What a global stands for."""
    known = name.replace("numpy._core.", "numpy.core.", 1)
    if known not in GLOBALS:
        raise SceneError(f"the global {name} is refused; valid in data: {', '.join(GLOBALS)}")
    return _Global(GLOBALS[known])


def _reduce(machine: _Machine, meaning: str, arguments: tuple[Any, ...]) -> Any:
    """What calling a global would give."""
    if meaning == "array":
        return np.empty(0)  # BUILD fills it
    if meaning == "dtype":
        return _Dtype(_of(arguments[0], str))
    if meaning == "scalar":
        return _array(machine, (), _of(arguments[0], _Dtype), "C", arguments[1]).item()
    if meaning == "buffer":
        raw, dtype, shape, order = arguments
        return _array(machine, shape, _of(dtype, _Dtype), order, raw)
    if meaning == "set":
        items = _of(arguments[0], list) if arguments else []
        machine.spend_copies(len(items))
        return set(_plain(items))
    if meaning == "dict":
        return {}
    raise SceneError(f"a call of the global {meaning!r} is refused")


def _build(machine: _Machine, target: Any, state: tuple[Any, ...]) -> None:
    """The second step of what numpy pickles: fills a dtype or an array."""
    if isinstance(target, _Dtype):
        _, target.order, _, names, fields, *_ = state
        if target.order not in ("<", ">", "|", "=") or names is not None or fields is not None:
            raise SceneError("a dtype of records or of an unknown byte order is refused")
    elif isinstance(target, np.ndarray):
        _, shape, dtype, fortran, raw = state
        filled = _array(machine, shape, _of(dtype, _Dtype), "F" if fortran else "C", raw)
        target.__setstate__((1, filled.shape, filled.dtype, bool(fortran), bytes(raw)))  # pyright: ignore[reportArgumentType]
    else:
        raise SceneError(f"the opcode BUILD on {type(target).__name__} is refused")


def _array(machine: _Machine, shape: Any, dtype: _Dtype, order: Any, raw: Any) -> np.ndarray:
    """An array from its bytes, of which there must be exactly as many as its shape says."""
    kind = dtype.numpy()
    if not isinstance(raw, (bytes, bytearray)):
        raise SceneError(f"an array whose content is of the type {type(raw).__name__} is refused")
    count = 1
    for size in _of(shape, tuple):
        if _of(size, int) < 0:
            raise SceneError(f"an array of the shape {shape}")
        count *= size
    if count * kind.itemsize != len(raw):
        raise SceneError(f"an array of the shape {shape} and {len(raw)} bytes; that shape needs {count * kind.itemsize}")
    machine.spend_copies(len(raw))
    if kind.kind == "U":
        _require_characters(np.frombuffer(raw, f"{dtype.order}u4"))
    return np.ndarray(shape, kind, buffer=raw if raw else None, order="F" if order == "F" else "C")


def _require_characters(codes: np.ndarray) -> None:
    """Refuse numbers that stand for no character: numpy would keep them, and Python's texts fail on them later."""
    if (bad := codes[codes > LAST_CODE_POINT]).size:
        raise SceneError(f"a text with the code point {bad[0]:#x}; valid: up to {LAST_CODE_POINT:#x}")


def _require_own_size(whole: Any, limit: int) -> None:
    """Refuse data that shares its parts so often that it holds more values than the file has bytes: a bomb for whoever walks it."""
    sizes: dict[int, int] = {}

    def size(value: Any, depth: int) -> int:
        if isinstance(value, np.ndarray):
            return value.size
        if not isinstance(value, (list, tuple, dict, set)) or not value:
            return 1
        if id(value) not in sizes:
            if depth > DEPTH:
                raise SceneError(f"containers nested deeper than {DEPTH}, or in themselves")
            parts = [*value.keys(), *value.values()] if isinstance(value, dict) else value
            sizes[id(value)] = 1 + sum(size(part, depth + 1) for part in parts)
        return sizes[id(value)]

    if (found := size(whole, 0)) > limit:
        raise SceneError(f"{found} values from {limit} bytes: {SHARED}")


def table(value: Any, where: str, *, columns: tuple[int, ...]) -> Float[np.ndarray, "N D"]:
    """Rows of numbers, as an array or as lists of lists; the caller asks whether they are finite.

    Raises:
        SceneError: no rows, not numbers, or another number of columns than one of `columns`.
    """
    array = numeric(value, where)
    if array.size == 0:
        return np.zeros((0, max(columns)))
    if array.ndim != 2 or array.shape[1] not in columns:
        raise SceneError(f"{where}: an array of the shape {array.shape}; valid: [N, {' or '.join(map(str, columns))}]")
    return array


def column(value: Any, where: str, *, length: int) -> Float[np.ndarray, " N"]:
    """A number for each step: as [N], as [N, 1], or one for all.

    Raises:
        SceneError: not numbers, or another length.
    """
    array = numeric(value, where)
    if array.shape not in ((), (length,), (length, 1)):
        raise SceneError(f"{where}: an array of the shape {array.shape}; valid: [{length}] or [{length}, 1], a number for each step")
    return np.array(np.broadcast_to(array.reshape(-1), (length,)))


def numeric(value: Any, where: str) -> Float[np.ndarray, "..."]:
    """An array or lists of lists as an array of numbers. What they can spell out is limited by `_require_own_size`."""
    if isinstance(value, np.ndarray) and value.dtype.kind not in "biuf":
        raise SceneError(f"{where}: an array of {value.dtype} is none of numbers")
    if not isinstance(value, (np.ndarray, list, tuple)) and not is_number(value):
        raise SceneError(f"{where}: {type(value).__name__} is not an array of numbers")
    try:
        return np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise SceneError(f"{where}: no array of numbers: {error}") from error
