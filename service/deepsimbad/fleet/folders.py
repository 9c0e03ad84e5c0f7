"""The folders of replicas, which outlive a process that is killed; the next one begun on the machine removes them."""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from deepsimbad.store.durable import lock_folder

_PREFIX = "deepsimbad-replica-"  # before the process's number


def new_folder() -> Path:
    """An empty folder of this process's, once those of processes that are gone were removed."""
    _clear_away()
    return Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}-"))


def _clear_away() -> None:
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # another user's
            process = Path("/proc", folder.name.removeprefix(_PREFIX).partition("-")[0], "exe")
            if process.exists():  # of one that ended and is not yet reaped it does not
                continue
            if (descriptor := lock_folder(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)) is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(descriptor)
