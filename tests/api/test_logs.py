"""Log lines are JSON, whatever is in them."""

import json
import logging

from deepsimbad.api.logs import JsonFormatter, configure_logging


def test_a_line_holds_message_extras_and_exception() -> None:
    record = logging.LogRecord("a.b", logging.WARNING, "file", 1, "two %s", ("words",), None)
    record.request_id = "r1"
    record.odd = {1, 2}
    line = json.loads(JsonFormatter().format(record))
    assert (line["level"], line["logger"], line["message"]) == ("WARNING", "a.b", "two words")
    assert line["request_id"] == "r1"
    assert line["odd"] == "{1, 2}"
    assert line["time"].endswith("Z")
    assert "exception" not in line


def test_an_exception_stays_on_one_line() -> None:
    try:
        raise ValueError("lone \ud800\nsurrogate")
    except ValueError as error:
        record = logging.LogRecord("a", logging.ERROR, "f", 1, "m", (), (ValueError, error, error.__traceback__))
    line = JsonFormatter().format(record)
    assert "\n" not in line
    assert line.isascii()
    assert "ValueError" in json.loads(line)["exception"]


def test_configuring_keeps_uvicorns_access_lines_out() -> None:
    root, ours = logging.getLogger(), logging.getLogger("deepsimbad")
    kept = root.handlers[:], root.level, ours.level
    try:
        configure_logging("ERROR")
        assert not logging.getLogger("uvicorn.access").isEnabledFor(logging.INFO)
        assert not ours.isEnabledFor(logging.WARNING)
    finally:
        root.handlers[:], ours.level = kept[0], kept[2]
        root.setLevel(kept[1])
        ours.setLevel(kept[2])
