"""The log of `--log FILE`: the command and its time, every message, and the traceback of a bug.

Everything goes through Python's `logging`, so that the messages of libraries are recorded too. Unlike results, the file
is appended to line by line: a log must hold what happened before a crash. A message is one line, which begins with its
time; only the lines of a traceback are indented.
"""

import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from pathlib import Path
from typing import Any

from faintfield.pipelines.console import console, visible, without_secrets
from faintfield.pipelines.errors import CannotWrite

logger = logging.getLogger("faintfield")
logger.setLevel(logging.INFO)
logger.addHandler(logging.NullHandler())  # without --log, nothing is printed


@contextmanager
def logged(path: Path | None, arguments: Sequence[str], one_line: tuple[type[BaseException], ...]) -> Iterator[None]:
    """Append to a file what happens while the block runs; do nothing if `path` is None.

    Failures of the types `one_line` are recorded by their message, any other with its traceback. Raises CannotWrite if
    the file cannot be opened.
    """
    if path is None:
        yield
        return
    from faintfield.pipelines.formats.provenance import versions

    handler = _opened(path)
    logging.getLogger().addHandler(handler)
    logging.captureWarnings(capture=True)
    begun_s = time.monotonic()
    try:
        logger.info("begins: faintfield %s (in %s)", " ".join(arguments), os.getcwd())
        logger.info("versions: %s", ", ".join(f"{name} {number}" for name, number in versions().items()))
        yield
        logger.info("done in %.1f s", time.monotonic() - begun_s)
    except BaseException as failure:
        known = isinstance(failure, (KeyboardInterrupt, SystemExit, *one_line))
        what = f"{type(failure).__name__}: {failure}"
        logger.error("ended after %.1f s by %s", time.monotonic() - begun_s, what, exc_info=not known)
        raise
    finally:
        logging.captureWarnings(capture=False)
        logging.getLogger().removeHandler(handler)
        handler.close()


def _opened(path: Path) -> logging.Handler:
    try:
        handler = _LogFile(path, encoding="utf-8")
    except OSError as failure:
        raise CannotWrite(f"--log {path}: {failure.strerror}; name a file that can be written") from failure
    lines = _Lines("%(asctime)s.%(msecs)03dZ %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    lines.converter = time.gmtime
    handler.setFormatter(lines)
    return handler


class _LogFile(logging.FileHandler):
    """A log that ends no command: what cannot be written is told once, and left out."""

    _complete = True

    def handleError(self, record: logging.LogRecord) -> None:
        if self._complete:
            self._complete = False
            failure = str(sys.exception())
            console.print(
                visible(f"warning: --log {self.baseFilename}: {failure}; the log is incomplete"), markup=False
            )

    def close(self) -> None:
        with suppress(OSError):
            super().close()


class _Lines(logging.Formatter):
    """Formats a message as one line, and indents its traceback; what either holds can forge no line, nor a secret."""

    def format(self, record: logging.LogRecord) -> str:
        record = copy(record)
        record.exc_text = None  # what another formatter has made of the traceback
        return super().format(record)

    def formatMessage(self, record: logging.LogRecord) -> str:
        return visible(without_secrets(super().formatMessage(record)))

    def formatException(self, ei: Any) -> str:
        lines = without_secrets(super().formatException(ei)).split("\n")
        return "\n".join(f"  {visible(line)}" for line in lines)
