"""How many cores there are to compute on."""

import os


def available_cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def job_threads(asked: int) -> int:
    """The threads that a job beside a living service computes in.

    Args:
        asked: As many; 0: one less than there are cores, so that one is always the service's.
    """
    return asked or max(1, available_cores() - 1)
