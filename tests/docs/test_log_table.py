"""The table of log lines tells every line that the service writes, with its level, and no other."""

import ast
import re
from pathlib import Path

import pytest

from .conftest import Page

PROJECT = Path(__file__).resolve().parents[2]
LEVELS = {"info": "INFO", "warning": "WARNING", "error": "ERROR", "exception": "ERROR"}


@pytest.fixture(scope="module")
def explained() -> dict[str, str]:
    """Level of every message in the table; a row has one level for all of its messages, or one for each."""
    page = Page(PROJECT / "docs" / "operations.md").text
    table = page.split("### Log lines")[1].split("### Metrics")[0]
    found: dict[str, str] = {}
    for first, second in re.findall(r"^\| (`[^|]*) \| ([A-Z, ]+) \|", table, re.MULTILINE):
        messages, levels = re.findall(r"`([^`]+)`", first), second.split(", ")
        found |= dict(zip(messages, levels if len(levels) > 1 else levels * len(messages), strict=True))
    return found


def messages_of(source: str) -> dict[str, str]:
    """Level of every message that is logged, as far as its words are constant: up to a colon."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(id="log" | "_log"), attr=method), args=[message, *_]) if (
                method in LEVELS
            ):
                words = [part.value for part in ast.walk(message) if isinstance(part, ast.Constant)]
                assert any(isinstance(each, str) for each in words), ast.unparse(node)
                found |= {each.split(":")[0]: LEVELS[method] for each in words if isinstance(each, str)}
    return found


def test_every_line_is_explained_and_no_other(explained: dict[str, str]) -> None:
    written: dict[str, str] = {}
    for path in (PROJECT / "service" / "deepsimbad").rglob("*.py"):
        written |= messages_of(path.read_text(encoding="utf-8"))
    assert len(written) > 30
    assert explained == written


def test_messages_are_found_in_every_form() -> None:
    source = 'log.info("a" if b else "c", extra={"d": 1})\n_log.exception("e: %s", f)\nlog.isEnabledFor("g")'
    assert messages_of(source) == {"a": "INFO", "c": "INFO", "e": "ERROR"}
