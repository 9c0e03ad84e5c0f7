"""Reading a Dockerfile, and doing what it says in a folder instead of an image.

It knows what our own file uses and refuses the rest, so that nothing is skipped in silence. Absolute paths of the image
are moved below the folder; what a stage copies comes from the context as `.dockerignore` leaves it.
"""

import fnmatch
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

WORDS = "ARG FROM WORKDIR COPY RUN LABEL ENV USER VOLUME EXPOSE HEALTHCHECK ENTRYPOINT CMD".split()  # noqa: SIM905


class Instruction(NamedTuple):
    """One instruction: its word, its options (`--from=build`) and the rest of it."""

    word: str
    options: Mapping[str, str]
    rest: str


class Stage(list[Instruction]):
    """One stage of the build."""

    def every(self, word):
        return [instruction for instruction in self if instruction.word == word]

    def rest_of(self, word):
        """The rest of the only instruction of that word."""
        (instruction,) = self.every(word)
        return instruction.rest


def stages_of(path):
    """A Dockerfile's stages by name, in order; what stands before the first has an empty name."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.lstrip().startswith("#")]
    stages = {"": Stage()}
    for line in re.sub(r"\\\n", " ", "\n".join(lines)).splitlines():
        word, _, rest = line.strip().partition(" ")
        options = {}
        while (option := re.match(r"--([a-z-]+)=(\S+)\s+", rest := rest.strip())) is not None:
            options[option[1]], rest = option[2], rest[option.end() :]
        if word == "FROM":
            stages[re.fullmatch(r"\S+ AS (\S+)", rest)[1]] = Stage()
        elif word:
            assert word in WORDS, f"{word} is not known here"
            stages[next(reversed(stages))].append(Instruction(word, options, rest))
    return stages


def pairs(text):
    """What an ARG or ENV sets."""
    return dict(pair.split("=", 1) if "=" in pair else (pair, "") for pair in shlex.split(text))


def context_of(project, into):
    """The build context: the files that `.dockerignore` lets through."""
    rules = [line for line in (project / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    assert rules[0] == "*", "everything is left out but what is named"
    dropped = [rule.removeprefix("**/") for rule in rules[1:] if not rule.startswith("!")]
    into.mkdir(parents=True)
    for name in (rule[1:] for rule in rules if rule.startswith("!")):
        if (project / name).is_dir():
            shutil.copytree(project / name, into / name, ignore=shutil.ignore_patterns(*dropped))
        elif not any(fnmatch.fnmatch(name, rule) for rule in dropped):
            shutil.copy2(project / name, into / name)
    return into


class Build:
    """Does stages, one after the other, below a folder that stands for the image's root.

    `moved_paths`, absolute ones of the image, lie below the folder; every command sees the `environment` besides the
    stage's own; build `arguments` stand in the place of their defaults.
    """

    def __init__(self, stages, context, folder, moved_paths, environment, arguments):
        self._stages, self._context, self._folder = stages, context, folder
        self._environment, self._arguments = environment, arguments
        self._moved_paths = re.compile(rf"(?<![\w.-])(?=(?:{'|'.join(map(re.escape, moved_paths))})(?![\w-]))")
        self.root, self.env = folder / "root", {}

    def moved_text(self, text):
        """The text with the image's paths moved."""
        return self._moved_paths.sub(str(self.root), text)

    def do(self, name):
        """Do a stage; from then on `root` is what it left and `env` what it set."""
        (place := self._folder / f"stage-{name}").mkdir()
        self.root.unlink(missing_ok=True)
        self.root.symlink_to(place)
        self.env, workdir = {}, place
        for instruction in self._stages[name]:
            match instruction.word:
                case "ARG":
                    self.env |= {
                        name: self._arguments.get(name, value) for name, value in pairs(instruction.rest).items()
                    }
                case "ENV":
                    self.env |= pairs(self.moved_text(instruction.rest))
                case "WORKDIR":
                    workdir = self.root / PurePosixPath(instruction.rest).relative_to("/")
                    workdir.mkdir(parents=True, exist_ok=True)
                case "COPY":
                    self._copy(instruction, workdir)
                case "RUN":
                    command, options = self.moved_text(instruction.rest), {"capture_output": True, "text": True}
                    options |= {"cwd": workdir, "env": {**self._environment, **self.env}}
                    process = subprocess.run(["/bin/sh", "-c", command], check=False, **options)
                    assert process.returncode == 0, f"{instruction.rest}\n{process.stdout}\n{process.stderr}"

    def _copy(self, instruction, workdir):
        *sources, target = instruction.rest.split()
        options = instruction.options
        origin = self._folder / f"stage-{options['from']}" if "from" in options else self._context
        into = self.root / target.lstrip("/") if target.startswith("/") else workdir / target
        for path in (origin / source.lstrip("/") for source in sources):
            if path.is_dir():  # a folder's contents, as Docker does it
                # A second name in the place of a second copy of 1.8 GB; what gets another owner is copied.
                copy = shutil.copy2 if "chown" in options else os.link
                shutil.copytree(path, into, symlinks=True, dirs_exist_ok=True, copy_function=copy)
            else:
                assert target.endswith("/"), f"COPY {path.name} into a folder"
                into.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, into / path.name)
        if "chown" in options and os.geteuid() == 0:
            user, group = map(int, options["chown"].split(":"))
            for path in (into, *into.rglob("*")):
                os.chown(path, user, group, follow_symlinks=False)
