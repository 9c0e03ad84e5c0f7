"""Log lines a machine can read: one JSON object each, on standard error."""

import json
import logging
import logging.config
import sys
import time
from functools import lru_cache
from itertools import islice

_ENCODER = json.JSONEncoder(default=str)
_N_STANDARD = len(logging.makeLogRecord({}).__dict__)
_STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName", "color_message"}


class JsonFormatter(logging.Formatter):
    """One line a record: time, level, logger, message, and whatever was given as `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """Render a record."""
        line = {
            "time": f"{_second(int(record.created))}.{int(record.msecs):03d}Z",
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        # What was given as `extra` was put behind what every record has.
        extra = islice(record.__dict__.items(), _N_STANDARD, None)
        line |= {name: value for name, value in extra if name not in _STANDARD}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return _ENCODER.encode(line)


@lru_cache(maxsize=2)
def _second(since_1970: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(since_1970))


def configure_logging(level: str) -> None:
    """Send everything at `level` and above to standard error as JSON lines; uvicorn's own lines too."""
    # No line of ours tells these, and every record would look them up.
    logging.logThreads = logging.logProcesses = logging.logMultiprocessing = False
    if sys.version_info >= (3, 12):
        logging.logAsyncioTasks = False
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"json": {"()": JsonFormatter}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "json"}},
            "root": {"level": "WARNING", "handlers": ["stderr"]},
            "loggers": {
                "deepsimbad": {"level": level},
                "uvicorn": {"level": level, "handlers": [], "propagate": True},
                "uvicorn.error": {"level": level},
                # One line a request is ours, with its id; uvicorn's would be a second.
                "uvicorn.access": {"level": "WARNING"},
            },
        }
    )
