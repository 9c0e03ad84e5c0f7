"""Where settings come from: flags before the environment, the environment before a file, the file before defaults."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_settings import EnvSettingsSource, TomlConfigSettingsSource
from pydantic_settings import SettingsError as UndecodableError

from deepsimbad.errors import SettingsError
from deepsimbad.settings import Settings

CONFIG_VARIABLE = "DEEPSIMBAD_CONFIG"
CONFIG_FILE = Path("deepsimbad.toml")


class Origin(StrEnum):
    """What decided a setting, strongest first."""

    FLAG = "flag"
    ENVIRONMENT = "environment"
    FILE = "file"
    DEFAULT = "default"


@dataclass(frozen=True)
class TracedSettings:
    """Settings, and where each comes from.

    Attributes:
        settings: The settings.
        origins: What decided each, by name.
        file: The settings file that was read, if any.
    """

    settings: Settings
    origins: Mapping[str, Origin]
    file: Path | None


def load_settings(config: Path | None = None, **given: object) -> Settings:
    """Settings from what is given, the environment, the settings file and the defaults, in this order.

    Args:
        config: The settings file; None: the one that $DEEPSIMBAD_CONFIG names, else ./deepsimbad.toml if it is there.
        **given: Settings by name, as flags give them; those that are None count as not given.

    Returns:
        The settings.

    Raises:
        SettingsError: The file cannot be read, a name is unknown or a value cannot be used.
    """
    return trace_settings(config, **given).settings


def trace_settings(config: Path | None = None, **given: object) -> TracedSettings:
    """As `load_settings`, with the origin of every setting."""
    file = _settings_file(config)
    found: dict[Origin, dict[str, Any]] = {
        Origin.FLAG: {name: value for name, value in given.items() if value is not None},
        Origin.ENVIRONMENT: _environment(),
        Origin.FILE: {} if file is None else _read(file),
        Origin.DEFAULT: {name: field.default for name, field in Settings.model_fields.items()},
    }
    for origin, values in found.items():
        for name in values:
            if name not in Settings.model_fields:
                raise _unknown(name, _place(origin, name, file))
    origins = {name: next(origin for origin in Origin if name in found[origin]) for name in Settings.model_fields}
    values = {name: found[origin][name] for name, origin in origins.items() if origin is not Origin.DEFAULT}
    try:
        settings = Settings(**values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        name = str(first["loc"][0]) if first["loc"] else "?"
        place = _place(origins.get(name, Origin.DEFAULT), name, file)
        raise SettingsError(f"setting {name!r} of {place} cannot be used: {first['msg']}", setting=name) from error
    return TracedSettings(settings, origins, file)


def unknown_variables() -> list[str]:
    """The variables of the environment that look like settings and are none: perhaps mistyped."""
    known = {variable_of(name) for name in Settings.model_fields} | {CONFIG_VARIABLE}
    known |= {"DEEPSIMBAD_URL", "DEEPSIMBAD_API_KEY", "DEEPSIMBAD_REAL_DATA"}  # the client's, and the tests'
    prefix = Settings.model_config["env_prefix"]
    return sorted(name for name in os.environ if name.startswith(prefix) and name not in known)


def variable_of(name: str) -> str:
    """The environment variable of a setting."""
    return f"{Settings.model_config['env_prefix']}{name.upper()}"


def _settings_file(config: Path | None) -> Path | None:
    """The file to read; a file that was asked for must be there, the one of the working folder need not."""
    asked_by = "--config"
    if config is None and os.environ.get(CONFIG_VARIABLE):
        config, asked_by = Path(os.environ[CONFIG_VARIABLE]), CONFIG_VARIABLE
    if config is None:
        return CONFIG_FILE if CONFIG_FILE.exists() else None
    if not config.exists():
        raise SettingsError(f"there is no settings file {config}, which {asked_by} names", file=str(config))
    return config


def _read(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise SettingsError(f"{file} is no settings file", file=str(file))
    try:
        return TomlConfigSettingsSource(Settings, toml_file=file)()
    except OSError as error:
        raise SettingsError(f"settings file {file} cannot be read: {error.strerror}", file=str(file)) from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"settings file {file} is not TOML: {error}", file=str(file)) from error


def _environment() -> dict[str, Any]:
    try:
        return EnvSettingsSource(Settings)()
    except UndecodableError as error:
        name = next((name for name in Settings.model_fields if f'"{name}"' in str(error)), "?")
        place = _place(Origin.ENVIRONMENT, name, None)
        raise SettingsError(f"setting {name!r} of {place} cannot be used: not a JSON list", setting=name) from error


def _place(origin: Origin, name: str, file: Path | None) -> str:
    places = {
        Origin.FLAG: "the command line",
        Origin.ENVIRONMENT: f"the environment ({variable_of(name)})",
        Origin.FILE: str(file),
        Origin.DEFAULT: "the defaults",
    }
    return places[origin]


def _unknown(name: str, place: str) -> SettingsError:
    near = get_close_matches(name.lower(), Settings.model_fields, 1)
    meant = f": did you mean {near[0]!r}?" if near else "; `deepsimbad settings` lists those there are"
    return SettingsError(f"there is no setting {name!r}, which stands in {place}{meant}", setting=name)
