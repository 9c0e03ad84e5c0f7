"""Both commands run in this process: a new process would spend a second and a half on its imports."""

import io
import re
import shlex
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepsimbad.cli import run as deepsimbad
from deepsimbad_client.commands import run as deepsimbad_client

PROGRAMS = {"deepsimbad": deepsimbad, "deepsimbad-client": deepsimbad_client}


@dataclass(frozen=True)
class CommandResult:
    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The one line on standard error that tells a named error."""
        assert (self.code, self.out) == (1, ""), self
        (line,) = self.err.splitlines()
        assert re.match(r"deepsimbad(-client)?: [a-z_]+: ", line)
        return line


def is_plain(text: str) -> bool:
    """Whether a line of the shell is one of the commands and asks nothing more of the shell."""
    return text.partition(" ")[0] in PROGRAMS and re.search(r"[|<>$`*;&\\]", text) is None


def run_command(text: str | list[object], folder: Path | None = None, **environment: str) -> CommandResult:
    """Run a command, given as a line or as words, in a folder."""
    program, *arguments = shlex.split(text) if isinstance(text, str) else map(str, text)
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patched, redirect_stdout(out), redirect_stderr(err):
        if folder is not None:
            patched.chdir(folder)
        for name, value in environment.items():
            patched.setenv(name, value)
        code = PROGRAMS[program](arguments)
    return CommandResult(code, out.getvalue(), err.getvalue())
