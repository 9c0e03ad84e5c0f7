"""The pages a person reads, and the pieces of them that can be run or compared."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


class Page:
    """One Markdown file.

    Attributes:
        path: Where it is.
        text: All of it.
        prose: What stands outside fenced blocks.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = path.read_text(encoding="utf-8")
        self.prose = _FENCE.sub("", self.text)

    def blocks(self, language: str) -> list[str]:
        return [body for name, body in _FENCE.findall(self.text) if name == language]

    def steps(self) -> Iterator[tuple[str, str]]:
        """In a reader's order: (language, line) of the shell blocks, (language, whole block) of the Python ones."""
        for language, body in _FENCE.findall(self.text):
            if language == "bash":
                yield from (("bash", line) for line in body.splitlines())
            elif language == "python":
                yield "python", body

    def commands(self) -> Iterator[str]:
        """Every line of the shell blocks, and what is written as code in the prose."""
        for block in self.blocks("bash"):
            yield from block.splitlines()
        yield from re.findall(r"`([^`\n]+)`", self.prose)


@pytest.fixture(scope="session")
def readme() -> Page:
    return Page(PROJECT / "README.md")


@pytest.fixture(scope="session")
def pages() -> list[Page]:
    """README, changelog and everything under docs."""
    docs = sorted((PROJECT / "docs").rglob("*.md"))
    assert len(docs) >= 7
    return [Page(path) for path in (PROJECT / "README.md", PROJECT / "CHANGELOG.md", *docs)]
