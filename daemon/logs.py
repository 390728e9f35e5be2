"""Log lines on standard error: a sentence, then key=value fields; with a priority for the journal."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from typing import IO

_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
_BARE = re.compile(r"[\w.:/@+-]+\Z")


def log(logger: logging.Logger, level: int, sentence: str, **fields: object) -> None:
    """Logs `sentence` with `fields` behind it, as in `capture mapped name=c000001 voxels=812`."""
    logger.log(level, sentence, extra={"fields": fields})


class LineFormatter(logging.Formatter):
    """One line an event; under a journal every line begins with its priority, `<6>` say."""

    def __init__(self, journal: bool) -> None:
        super().__init__("%(message)s" if journal else "%(asctime)s %(levelname)-7s %(message)s")
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """Returns the line; the lines of a traceback each carry the priority too."""
        fields: dict[str, object] = getattr(record, "fields", {})
        head, *trace = super().format(record).split("\n")
        if trace and not record.exc_info:  # a fault list in a message: one line for grep
            head, trace = " | ".join([head, *(part.strip() for part in trace)]), []
        line = " ".join([head, *(f"{key}={_value(value)}" for key, value in fields.items())])
        if not self._journal:
            return "\n".join([line, *trace])
        prefix = f"<{_PRIORITY.get(record.levelno, 5)}>"
        return "\n".join(prefix + part for part in [line, *trace])


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    return text if _BARE.match(text) else json.dumps(text, ensure_ascii=False)


def under_journal(stream: IO[str]) -> bool:
    """Whether `stream` goes to systemd's journal ($JOURNAL_STREAM names its device and inode)."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def configure(level: str = "info") -> None:
    """Sends all logs to standard error, in the journal's form where that is the journal.

    May be called again, with another level. Libraries are only heard when something is wrong.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(under_journal(sys.stderr)))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    for name in ("surfclass", "daemon", "drivers"):
        logging.getLogger(name).setLevel(level.upper())
