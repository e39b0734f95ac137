"""End by SIGTERM or SIGHUP: interrupt what runs, as Ctrl-C does, so that a stage is brought to rest."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ENDINGS = [signal.SIGTERM]
if sys.platform != "win32":  # which tells a program nothing when its terminal is closed
    _ENDINGS.append(signal.SIGHUP)


class Terminated(KeyboardInterrupt):
    """A command was ended by a signal of this number.

    The system or another program ended the command, or its terminal was closed; the stage was told to stop. The same
    command resumes; let `nohup` or `tmux` run a capture whose terminal may be closed.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def interrupt_on_termination() -> Iterator[None]:
    """Raise `Terminated` in the block on SIGTERM, or on SIGHUP, as when a terminal is closed; more of them are ignored.

    A signal that is ignored already, as by `nohup`, stays ignored. Whatever else fails as the block ends, such as a
    message to a terminal that is closed, `Terminated` is what is raised.
    """
    handled = [number for number in _ENDINGS if signal.getsignal(number) is signal.SIG_DFL]
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        for other in handled:
            signal.signal(other, signal.SIG_IGN)
        received.append(number)
        raise Terminated(number)

    for number in handled:
        signal.signal(number, interrupt)
    try:
        yield
    except Terminated:
        raise
    except BaseException as failure:
        if received:
            raise Terminated(received[0]) from failure
        raise
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)
