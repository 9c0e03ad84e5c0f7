"""How many cores there are to compute on."""

from deepsimbad.evaluators.compute import available_cores


def job_threads(asked: int) -> int:
    """The threads that a job beside a living service computes in.

    Args:
        asked: As many; 0: one less than there are cores, so that one is always the service's.
    """
    return asked or max(1, available_cores() - 1)
