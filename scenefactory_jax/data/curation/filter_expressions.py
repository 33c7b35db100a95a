"""Conditions on metadata as text: `vehicles >= 8 and lights > 0 and dataset == "WOMD"`.

The text is parsed with `ast`, never evaluated. It may hold column names, numbers, strings, True and False; comparisons (also chained, and
`in` a list); `and`, `or`, `not`; `+`, `-`, `*`, `/` and brackets. Anything else is refused. A row whose value is missing (null) fails every
comparison, and its opposite as well: neither `sdc_distance_m > 10` nor `not sdc_distance_m > 10` finds a scene without an SDC.
"""
# pyright: reportAttributeAccessIssue=false
# pyarrow makes the functions of `compute` when it is imported

import ast
import difflib
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
from jaxtyping import Int

from scenefactory_jax.core.instantiate import ConfigError

COMPARISONS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
ARITHMETIC: dict[type, Callable[[Any, Any], Any]] = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}
GRAMMAR = 'valid: columns, numbers, "strings", True, False, < <= > >= == !=, in [..], and, or, not, + - * /, brackets'


def rows(table: pa.Table, text: str, *, where: str) -> Int[np.ndarray, " N"]:
    """The rows of a table for which a condition is true, ascending.

    Args:
        table: one row a scene.
        text: the condition.
        where: the config key that holds it, for messages.

    Raises:
        ConfigError: what is no condition, a column that is not there (with the nearest names, and all), or values of other types.
    """
    expression = parse(text, table.schema, where=where)
    try:
        answer = pads.dataset(table).to_table(columns={"answer": expression}).column("answer")
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise ConfigError(f"{where}: {text!r}: values that cannot be compared or counted with: {str(error).splitlines()[0]}") from error
    if not pa.types.is_boolean(answer.type):
        raise ConfigError(f"{where}: {text!r} is a value of type {answer.type}, no condition; compare it: ({text}) > 0")
    return np.flatnonzero(answer.fill_null(False).to_numpy(zero_copy_only=False))


def parse(text: str, schema: pa.Schema, *, where: str) -> pc.Expression:
    """A condition as an expression of pyarrow.

    Raises:
        ConfigError: see `rows`.
    """
    if not isinstance(text, str) or not text.strip():
        raise ConfigError(f"{where}: {text!r} is no condition; write one such as 'vehicles >= 8 and dataset == \"WOMD\"'")
    try:
        tree = ast.parse(text.strip(), mode="eval")
        return _expression(tree.body, text.strip(), schema, where)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
        if isinstance(error, ConfigError):
            raise
        place = f" at {text.strip()[max((error.offset or 1) - 1, 0) :][:12]!r}" if isinstance(error, SyntaxError) else ""
        raise ConfigError(f"{where}: {text!r} is no condition{place}; {GRAMMAR}") from None


def _expression(node: ast.expr, text: str, schema: pa.Schema, where: str) -> Any:
    """One node and what is below it."""

    def below(child: ast.expr) -> Any:
        return _expression(child, text, schema, where)

    match node:
        case ast.Name(id=name):
            return _column(name, schema, where)
        case ast.Constant(value=bool() | float() | str() as value):
            return pc.scalar(value)
        case ast.Constant(value=int() as value):
            return pc.scalar(pa.scalar(value, pa.int64()))  # of itself pyarrow takes the narrowest type, and 100 + 100 overflows
        case ast.BoolOp(op=op, values=values):
            parts = [below(value) for value in values]
            result = parts[0]
            for part in parts[1:]:
                result = result & part if isinstance(op, ast.And) else result | part
            return result
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return ~below(operand)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return pc.negate(below(operand))
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return pc.divide(below(left).cast(pa.float64()), below(right).cast(pa.float64()))  # 7 / 2 is 3.5, 1 / 0 infinite
        case ast.BinOp(left=left, op=op, right=right) if type(op) in ARITHMETIC:
            return ARITHMETIC[type(op)](below(left), below(right))
        case ast.Compare(left=left, ops=ops, comparators=others):
            sides = [left, *others]
            result = _compare(sides[0], ops[0], sides[1], below, text, where)
            for one, op, other in zip(sides[1:], ops[1:], sides[2:], strict=False):
                result = result & _compare(one, op, other, below, text, where)
            return result
    raise _refused(node, text, where)


def _compare(left: ast.expr, op: ast.cmpop, right: ast.expr, below: Callable[[ast.expr], Any], text: str, where: str) -> Any:
    """One comparison, or one look into a list of values."""
    if type(op) in COMPARISONS:
        return COMPARISONS[type(op)](below(left), below(right))
    if isinstance(op, (ast.In, ast.NotIn)) and isinstance(right, (ast.List, ast.Tuple, ast.Set)) and right.elts:
        value = below(left)
        found = value == below(right.elts[0])
        for element in right.elts[1:]:
            found = found | (value == below(element))
        return found if isinstance(op, ast.In) else ~found
    raise _refused(right, text, where)


def _column(name: str, schema: pa.Schema, where: str) -> pc.Expression:
    """A column by its name."""
    if name in schema.names:
        return pc.field(name)
    near = difflib.get_close_matches(name, schema.names, n=3)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    raise ConfigError(f"{where}: unknown column {name!r}; {hint}valid: {', '.join(sorted(schema.names))}")


def _refused(node: ast.expr, text: str, where: str) -> ConfigError:
    """What has no place in a condition."""
    return ConfigError(f"{where}: {(ast.get_source_segment(text, node) or text)!r} has no place in a condition; {GRAMMAR}")
