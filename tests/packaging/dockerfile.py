"""Reading a Dockerfile, and doing what it says in a folder instead of an image.

It knows what our own file uses and refuses the rest, so that nothing is skipped in silence. Absolute paths of the image
are moved below the folder; what a stage copies comes from the context as `.dockerignore` leaves it.
"""

import fnmatch
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

KNOWN = frozenset(
    "ARG FROM WORKDIR COPY RUN LABEL ENV USER VOLUME EXPOSE HEALTHCHECK ENTRYPOINT CMD".split()  # noqa: SIM905
)


@dataclass(frozen=True)
class Instruction:
    """One instruction: its word, its options (`--from=build`) and the rest of it."""

    word: str
    options: Mapping[str, str]
    rest: str

    def exec_form(self) -> list[str]:
        """The words of the JSON form; an AssertionError where it is the shell's."""
        words = json.loads(self.rest)
        assert isinstance(words, list), self
        return words


@dataclass
class Stage:
    """One stage of the build."""

    name: str
    base: str
    instructions: list[Instruction] = field(default_factory=list)

    def every(self, word: str) -> list[Instruction]:
        return [each for each in self.instructions if each.word == word]

    def one(self, word: str) -> Instruction:
        (found,) = self.every(word)
        return found


@dataclass(frozen=True)
class Dockerfile:
    """All of it: ARGs before the first stage, and the stages by name."""

    arguments: dict[str, str]
    stages: dict[str, Stage]

    @classmethod
    def read(cls, path: Path) -> "Dockerfile":
        arguments: dict[str, str] = {}
        stages: dict[str, Stage] = {}
        stage: Stage | None = None
        for instruction in _instructions(path.read_text(encoding="utf-8")):
            assert instruction.word in KNOWN, f"{instruction.word} is not known here"
            if instruction.word == "FROM":
                base, name = re.fullmatch(r"(\S+) AS (\S+)", instruction.rest).groups()  # type: ignore[union-attr]
                stage = stages[name] = Stage(name, base)
            elif stage is not None:
                stage.instructions.append(instruction)
            else:
                assert instruction.word == "ARG"
                arguments.update(_pairs(instruction.rest))
        return cls(arguments, stages)


def _instructions(text: str) -> Iterator[Instruction]:
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    for line in re.sub(r"\\\n", " ", "\n".join(lines)).splitlines():
        if not line.strip():
            continue
        word, _, rest = line.strip().partition(" ")
        options = {}
        while (option := re.match(r"--([a-z-]+)=(\S+)\s+", rest := rest.strip())) is not None:
            options[option[1]] = option[2]
            rest = rest[option.end() :]
        yield Instruction(word, options, rest.strip())


def _pairs(text: str) -> dict[str, str]:
    return dict(pair.split("=", 1) if "=" in pair else (pair, "") for pair in shlex.split(text))


def context_of(project: Path, into: Path) -> Path:
    """The build context: the files that `.dockerignore` lets through."""
    rules = [line for line in (project / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    assert rules[0] == "*", "everything is left out but what is named"
    kept = [rule[1:] for rule in rules if rule.startswith("!")]
    dropped = [rule.removeprefix("**/") for rule in rules[1:] if not rule.startswith("!")]
    for name in kept:
        source = project / name
        assert source.exists(), f".dockerignore keeps {name}, which is not there"
        if source.is_dir():
            shutil.copytree(source, into / name, ignore=shutil.ignore_patterns(*dropped))
        elif not any(fnmatch.fnmatch(name, rule) for rule in dropped):
            into.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, into / name)
    return into


class Build:
    """Does the stages, one after the other, below a folder that stands for the image's root.

    Args:
        dockerfile: What to do.
        context: The build context.
        folder: Where.
        moved: Absolute paths of the image that are moved below the folder.
        environment: What every command sees besides the stage's own.
        given: Build arguments, in the place of their defaults.
    """

    def __init__(
        self,
        dockerfile: Dockerfile,
        context: Path,
        folder: Path,
        moved: list[str],
        environment: dict[str, str],
        given: Mapping[str, str],
    ) -> None:
        self.dockerfile = dockerfile
        self.context = context
        self.folder = folder
        self.root = folder / "root"
        self.environment = environment
        self.given = given
        self._moved = re.compile(rf"(?<![\w.-])(?=(?:{'|'.join(map(re.escape, moved))})(?![\w-]))")
        self.env: dict[str, str] = {}

    def here(self, text: str) -> str:
        """The text with the image's paths moved."""
        return self._moved.sub(str(self.root), text)

    def do(self, name: str) -> None:
        """Do a stage; from then on `root` is what it left."""
        stage = self.dockerfile.stages[name]
        place = self.folder / f"stage-{name}"
        place.mkdir()
        self.root.unlink(missing_ok=True)
        self.root.symlink_to(place)
        self.env = {}
        workdir = PurePosixPath("/")
        for each in stage.instructions:
            if each.word == "ARG":
                self.env.update({name: self.given.get(name, value) for name, value in _pairs(each.rest).items()})
            elif each.word == "ENV":
                self.env.update(_pairs(self.here(each.rest)))
            elif each.word == "WORKDIR":
                workdir /= each.rest
                self.path(workdir).mkdir(parents=True, exist_ok=True)
            elif each.word == "COPY":
                self._copy(each, workdir)
            elif each.word == "RUN":
                self.shell(each.rest, self.path(workdir))

    def path(self, inside: PurePosixPath) -> Path:
        return self.root / inside.relative_to("/")

    def shell(self, command: str, cwd: Path) -> None:
        done = subprocess.run(
            ["/bin/sh", "-c", self.here(command)],
            cwd=cwd,
            env={**self.environment, **self.env},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"

    def _copy(self, each: Instruction, workdir: PurePosixPath) -> None:
        *sources, target = each.rest.split()
        origin = self.folder / f"stage-{each.options['from']}" if "from" in each.options else self.context
        into = self.path(workdir / target)
        for source in sources:
            found = origin / source.lstrip("/")
            assert found.exists(), f"COPY {source}: not there"
            if found.is_dir():  # a folder's contents, as Docker does it
                shutil.copytree(found, into, symlinks=True, dirs_exist_ok=True)
            elif target.endswith("/"):
                into.mkdir(parents=True, exist_ok=True)
                shutil.copy2(found, into / found.name)
            else:
                shutil.copy2(found, into)
        if (owner := each.options.get("chown")) is not None and os.geteuid() == 0:
            user, group = map(int, owner.split(":"))
            for path in (into, *into.rglob("*")):
                os.chown(path, user, group, follow_symlinks=False)
