"""Backends that move the cars of one world: `mjx_car`, `bicycle` and `replay`, each a module with `make(...) -> Dynamics`."""
