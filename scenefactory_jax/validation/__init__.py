"""Experiments that compare the batched cars with MuJoCo's C engine: the cases, both engines' runs, and what the two say."""
