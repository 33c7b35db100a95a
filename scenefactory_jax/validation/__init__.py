"""Experiments that compare the batched cars with MuJoCo's C engine: the cases, both engines' runs of them, and what to read from the two."""
