"""A process in which Python offers what it offers on Windows, for the commands that do without a rig.

`python -m tests.windows FOLDER COMMANDS` loads all modules of faintfield, then runs commands in the folder, a line
each, with empty drawings. Modules and names of POSIX alone are missing. Within the folder, what is open can be neither
removed nor renamed, folders cannot be opened, links cannot be made, and names are those that Windows allows. The module
`msvcrt` locks by Linux's locks of open file descriptions, which are as exclusive. What else differs on Windows is not
tested.
"""

import errno
import fcntl
import mmap
import os
import pkgutil
import select
import shlex
import shutil
import signal
import struct
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from inspect import currentframe
from pathlib import Path
from threading import local
from types import ModuleType
from unittest import mock

import psutil
from matplotlib.figure import Figure

import faintfield
from tests.drawings import save_empty

_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
_NAMES: dict[ModuleType, tuple[str, ...]] = {
    os: (
        *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "O_SYNC", "chown", "fchown", "fork", "forkpty"),
        *("getegid", "geteuid", "getgid", "getloadavg", "getpgid", "getuid", "killpg", "login_tty", "mkfifo", "mknod"),
        *("nice", "openpty", "posix_fadvise", "posix_fallocate", "pread", "preadv", "pwrite", "pwritev"),
        *("sched_getaffinity", "sched_setaffinity", "setpriority", "setsid", "sync", "sysconf", "ttyname"),
    ),
    signal: ("SIGALRM", "SIGHUP", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGUSR1", "SIGUSR2", "alarm", "pause", "setitimer"),
    select: ("epoll", "poll"),
    mmap: ("MADV_DONTNEED", "MAP_SHARED", "PROT_READ"),
}
_EVENTS = ("open", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink")


class Sys(ModuleType):
    """The module `sys`, as faintfield sees it."""

    platform = "win32"

    def __getattr__(self, name: str) -> object:
        """Return what does not differ."""
        return getattr(sys, name)


class Msvcrt(ModuleType):
    """The locks of the module `msvcrt`."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self._fcntl, self._set = fcntl.fcntl, fcntl.F_OFD_SETLK

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        """Lock bytes from the present position on."""
        start = os.lseek(descriptor, 0, os.SEEK_CUR)
        can_write = self._fcntl(descriptor, fcntl.F_GETFL) & os.O_RDWR  # Linux asks for that, Windows does not
        kind = fcntl.F_WRLCK if can_write else fcntl.F_RDLCK
        try:
            self._fcntl(descriptor, self._set, struct.pack("hhqqi", kind, os.SEEK_SET, start, count, 0))
        except BlockingIOError as failure:
            raise PermissionError(errno.EACCES, "Permission denied") from failure


class _FileRules:
    """The rules of Windows for files in a folder, as a hook of Python's audit events."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._of_thread = local()

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        """Raise OSError for what Windows refuses."""
        if event not in _EVENTS or hasattr(self._of_thread, "busy"):
            return
        self._of_thread.busy = True  # looking at files raises events, too
        try:
            paths = [Path(os.fsdecode(name)) for name in arguments[:2] if isinstance(name, str | bytes | Path)]
            for path in [path.absolute() for path in paths if event != "open" or path == paths[0]]:
                if path.is_relative_to(self._folder):
                    self._judge(event, path)
                elif path.parts[1] in ("proc", "sys") and _caller().startswith("faintfield."):
                    raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))
        finally:
            del self._of_thread.busy

    def _judge(self, event: str, path: Path) -> None:
        if any(set(name) & set('<>:"|?*\\') or name[-1:] in {".", " "} for name in path.parts[1:]):
            raise OSError(errno.EINVAL, "Invalid argument", str(path))
        if event == "os.symlink":
            raise OSError(errno.EPERM, "A required privilege is not held by the client", str(path))
        if event == "open" and path.is_dir():
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        if event in ("os.remove", "os.rename", "os.rmdir"):
            whole = path.resolve()
            if any(used.is_relative_to(whole) for used in _files_in_use(str(whole))):
                raise PermissionError(errno.EACCES, "The file is used by another process", str(path))


def _caller() -> str:
    """Return the module, other than this and pathlib, from which the present function is called."""
    frame = currentframe()
    while frame is not None and frame.f_globals["__name__"].partition(".")[0] in (
        __name__.partition(".")[0],
        "pathlib",
    ):
        frame = frame.f_back
    return "" if frame is None else str(frame.f_globals["__name__"])


def _files_in_use(words: str) -> Iterator[Path]:
    """Yield the files that are open or mapped and whose paths contain these words."""
    for descriptor in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if words in (name := os.readlink(f"/proc/self/fd/{descriptor}")):
                yield Path(name)
    with open("/proc/self/maps", encoding="utf-8") as maps:  # thousands of lines, of libraries
        yield from (Path(line.split(maxsplit=5)[-1].strip()) for line in maps if words in line)


def _rename(source: str, target: str) -> None:
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, "Cannot create a file when that file already exists", source)
    os.replace(source, target)


def _load_all() -> None:
    for module in pkgutil.walk_packages(faintfield.__path__, "faintfield."):
        import_module(module.name)


def _become_windows(folder: Path) -> None:
    """Hide what Windows lacks; other packages, which have their own ways there, are loaded already."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "faintfield"]:
        del sys.modules[name]
    memory = psutil.virtual_memory()
    psutil.virtual_memory = lambda: memory
    msvcrt = Msvcrt()
    for name in _MODULES:
        vars(sys)["modules"][name] = None
    for holder, names in _NAMES.items():
        for name in names:
            delattr(holder, name)
    sys.modules["msvcrt"] = msvcrt
    vars(os)["rename"] = _rename
    vars(shutil)["_use_fd_functions"] = False  # opens folders
    tempfile.tempdir = str(folder)
    warnings.filterwarnings("ignore", category=EncodingWarning)
    warnings.filterwarnings("error", category=EncodingWarning, module="faintfield")
    sys.addaudithook(_FileRules(folder))


def main() -> None:
    """Run the commands."""
    folder = Path(sys.argv[1]).resolve()
    os.chdir(folder)
    mock.patch.object(Figure, "savefig", save_empty).start()
    _load_all()
    _become_windows(folder)
    vars(sys)["modules"]["sys"] = Sys("sys")
    _load_all()
    vars(sys)["modules"]["sys"] = sys
    cli = import_module("faintfield.pipelines.cli")
    for line in sys.argv[2].splitlines():
        if (code := cli.run(shlex.split(line))) != 0:
            sys.exit(f"{line}: ended with {code}")


if __name__ == "__main__":
    main()
