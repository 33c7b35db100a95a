"""What code on a page or in a notebook imports and calls of the package, checked without running it."""

import ast
import inspect


def bind_calls(code, name="page"):
    """Runs the imports of the code, and fits the arguments of every call of one of the package's functions to its signature.

    Returns the names of the functions. Names that the code itself assigns are left alone.

    Raises:
        ImportError, AttributeError, TypeError: what is imported, named or called is not there, or not like that.
    """
    tree, found = ast.parse(code, name), {}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module(imports, []), name, "exec"), found)
    assigned = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    assigned |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    known = {key: value for key, value in found.items() if key not in assigned}
    called = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and (function := resolve(node.func, known)) is not None:
            if any(isinstance(one, ast.Starred) for one in node.args) or any(word.arg is None for word in node.keywords):
                continue
            try:
                inspect.signature(function).bind(*node.args, **{word.arg: word.value for word in node.keywords})
            except TypeError as error:
                raise TypeError(f"{name}: {ast.unparse(node)}: {error}") from None
            called.append(ast.unparse(node.func))
    return called


def resolve(node, known):
    """The function of the package that an expression names; None for any other expression, and for exceptions."""
    path = []
    while isinstance(node, ast.Attribute):
        path.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name) or node.id not in known:
        return None
    value = known[node.id]
    if not (getattr(value, "__module__", None) or getattr(value, "__name__", "")).startswith("scenefactory_jax"):
        return None
    for name in reversed(path):
        value = getattr(value, name)
    return value if callable(value) and not (isinstance(value, type) and issubclass(value, Exception)) else None
