"""How many files the process may have open: a connection is one, and so is every map, traverse and recording."""

import logging

try:
    import resource
except ImportError:  # another kind of system has other limits
    resource = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

OWN_FILES = 512  # what the service opens beside its connections


def allow_open_files(n_connections: int) -> None:
    """Raise the process's own limit where it is below what so many connections need; warn where that is not allowed."""
    if resource is None:
        return
    needed = n_connections + OWN_FILES
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = needed if most == resource.RLIM_INFINITY else min(needed, most)
    if now != resource.RLIM_INFINITY and now < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, most))
    if allowed < needed:
        log.warning(
            "the system allows too few open files for max_connections: raise its limit (ulimit -n), or lower it",
            extra={"allowed": allowed, "needed": needed},
        )
