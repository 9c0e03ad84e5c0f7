"""Where everything lies under the data directory, and which names may become paths; paths raise InvalidInputError."""

import re
from pathlib import Path

from deepsimbad.errors import InvalidInputError

NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
_MAX_VERSION = 2**53


def is_name(name: str) -> bool:
    """Whether a domain or traverse may have the name."""
    return re.fullmatch(NAME_PATTERN, name) is not None


def checked_name(name: str, kind: str) -> str:
    """The name itself, safe to become part of a path; raises InvalidInputError."""
    if not is_name(name):
        raise InvalidInputError(
            f"a {kind} is named by 1 to 64 letters, digits, '.', '_' or '-', the first a letter or digit",
            pattern=NAME_PATTERN,
        )
    return name


def catalog_path(data_dir: Path) -> Path:
    """The catalog file."""
    return data_dir / "catalog.sqlite"


def sessions_path(data_dir: Path) -> Path:
    """The file of live sessions."""
    return data_dir / "sessions.sqlite"


def service_lock_path(data_dir: Path) -> Path:
    """The file in which the one service of a data directory says who it is."""
    return data_dir / "service.lock"


def domains_folder(data_dir: Path) -> Path:
    """The folder of all domains."""
    return data_dir / "domains"


def domain_folder(data_dir: Path, domain: str) -> Path:
    """The folder of one domain."""
    return domains_folder(data_dir) / checked_name(domain, "domain")


def traverses_folder(data_dir: Path, domain: str) -> Path:
    """The folder of a domain's traverses."""
    return domain_folder(data_dir, domain) / "traverses"


def traverse_path(data_dir: Path, domain: str, name: str) -> Path:
    """The file of one traverse."""
    return traverses_folder(data_dir, domain) / f"{checked_name(name, 'traverse')}.sqlite"


def thumbnails_path(data_dir: Path, domain: str) -> Path:
    """The file of a domain's small pictures."""
    return domain_folder(data_dir, domain) / "thumbnails.sqlite"


def maps_folder(data_dir: Path, domain: str) -> Path:
    """The folder of a domain's maps."""
    return domain_folder(data_dir, domain) / "maps"


def map_path(data_dir: Path, domain: str, version: int) -> Path:
    """The sealed file of one map version."""
    if not 1 <= version <= _MAX_VERSION:
        raise InvalidInputError(f"map versions count from 1; {version} is none")
    return maps_folder(data_dir, domain) / f"{version:06d}.sqlite"
