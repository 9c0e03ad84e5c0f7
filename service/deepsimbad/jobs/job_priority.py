"""How far a job gives way to whatever else runs on the machine (decision 0011)."""

import os
from contextlib import suppress
from enum import StrEnum

_LOWEST_NICE = 19


class JobPriority(StrEnum):
    """From the politest on."""

    IDLE = "idle"
    LOW = "low"
    NORMAL = "normal"


def take_priority(priority: JobPriority) -> None:
    """Let this process, and the threads it starts from now on, run so; what a system does not have is left out.

    Idle takes the machine only while nobody else wants it. Low, batch work at nice 19, still keeps about a seventieth
    of a contended core, so that it goes on where others never rest, and, worse for them, is not preempted by a thread
    that wakes up. An idle-class thread is preempted at once, and the kernel (since 5.4) counts a core that runs
    nothing else as free when it places a waking thread.
    """
    if priority is JobPriority.NORMAL:
        return
    with suppress(OSError):
        os.nice(_LOWEST_NICE)
    if hasattr(os, "SCHED_IDLE"):
        with suppress(OSError):
            kind = os.SCHED_IDLE if priority is JobPriority.IDLE else os.SCHED_BATCH
            os.sched_setscheduler(0, kind, os.sched_param(0))
