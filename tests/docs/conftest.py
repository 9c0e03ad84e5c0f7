"""The pages a person reads, the pieces of them that can be run or compared, and a place where they are run."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from deepsimbad_client.http.local_server import LocalServer

from ..commands import is_plain, run_command

PROJECT = Path(__file__).resolve().parents[2]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NOT_RUN = ("make ", "pip install ")  # compared in test_references instead
EXPECTED_TO_FAIL = "problem.json"


class Page:
    """One Markdown file: all of its text, and what of it stands outside fenced blocks."""

    def __init__(self, path):
        self.path, self.text = path, path.read_text(encoding="utf-8")
        self.prose = FENCE.sub("", self.text)

    def blocks(self, language):
        return [body for name, body in FENCE.findall(self.text) if name == language]

    def steps(self):
        """In a reader's order: (language, line) of the shell blocks, (language, whole block) of the Python ones."""
        for language, body in FENCE.findall(self.text):
            if language == "bash":
                yield from (("bash", line) for line in body.splitlines())
            elif language == "python":
                yield "python", body

    def commands(self):
        """Every line of the shell blocks, and what is written as code in the prose."""
        for block in self.blocks("bash"):
            yield from block.splitlines()
        yield from re.findall(r"`([^`\n]+)`", self.prose)


class Workplace:
    """A folder, a service of its own, and what every command said there.

    Attributes:
        words: What stands in the pages, and what it is here.
    """

    def __init__(self, folder, **words):
        self.folder, self.words, self.output, self.url = folder, words, {}, "http://127.0.0.1:1"

    def serve(self, data_dir, stack):
        self.url = stack.enter_context(LocalServer(self.folder / data_dir)).url

    def follow(self, page, stack):
        """Do all that the page shows."""
        for language, text in page.steps():
            if text.startswith("deepsimbad serve"):
                self.serve(text.split()[-1], stack)
            elif language == "python":
                self.run(text, sys.executable, "-W", "error", "-c")
            elif not text.startswith(NOT_RUN):
                self.run(text)

    def run(self, text, *program):
        """Run a line of the shell, or a text by a program; returns what it printed, which is no failure's."""
        fails = "" if EXPECTED_TO_FAIL in text or program else 'curl() { command curl -sS --fail-with-body "$@"; }\n'
        command_text = text
        for original, word in {"http://127.0.0.1:8000": self.url, **self.words}.items():
            command_text = command_text.replace(original, str(word))
        environment = {"DEEPSIMBAD_URL": self.url}
        if (key := self.folder / "operator.key").is_file():
            environment["DEEPSIMBAD_API_KEY"] = key.read_text().strip()
        if is_plain(text) and not program:
            plain = run_command(command_text, self.folder, **environment)
            assert plain.code == 0, f"{text}\n{plain.out}{plain.err}"
            self.output[text] = plain.out
            return plain.out
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        options = {"cwd": self.folder, "env": {**os.environ, "PATH": path, **environment}, "timeout": 400}
        command = [*(program or ("bash", "-c")), fails + command_text]
        process = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, **options)
        assert process.returncode == 0, f"{text}\n{process.stdout}{process.stderr}"
        self.output[text] = process.stdout
        return process.stdout

    def answer_of(self, part):
        """What the one command printed that holds these words."""
        (printed,) = [printed for command, printed in self.output.items() if part in command]
        return printed

    def printed_by_python(self):
        """What each Python example printed."""
        return [printed for command, printed in self.output.items() if "import Client" in command]


@pytest.fixture(scope="session")
def readme():
    return Page(PROJECT / "README.md")


@pytest.fixture(scope="session")
def pages():
    """README, changelog and everything under docs."""
    docs = sorted((PROJECT / "docs").rglob("*.md"))
    assert len(docs) >= 7
    return [Page(path) for path in (PROJECT / "README.md", PROJECT / "CHANGELOG.md", *docs)]


@pytest.fixture(scope="session")
def nclt(rendered):
    """A folder in NCLT's layout."""
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("the examples need curl and bash")
    return rendered
