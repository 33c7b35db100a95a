"""Dynamics backends, which move the cars of one world: `articulated`, `bicycle`, `log_playback`; each has `make(...) -> Dynamics`."""
