"""The failures of files and folders that a command is given: `InputError` and its subclasses.

Every message states what is wrong, the value found, its limit, and what to do.
"""

from importlib import import_module
from typing import Any

from faintfield.calib.errors import CalibrationError
from faintfield.recon.errors import ReconstructionError
from faintfield.rig.errors import RigError


class InputError(Exception):
    """A command's input, its output or a resource that it needs cannot be used.

    All failures of files and folders are of this class. Each message says what is wrong, the value and its limit, and
    after a semicolon what to do.

    Examples
    --------
    >>> from pathlib import Path
    >>> from faintfield import InputError, load_set
    >>> try:
    ...     load_set(Path("dark_scene"))
    ... except InputError as failure:
    ...     print(failure)
    dark_scene: no such folder; name a session, or a folder with elemental.toml
    """


class MissingFile(InputError):
    """A file or folder does not exist, or cannot be read."""


class UnreadableImage(InputError):
    """An image file cannot be decoded, or does not hold one picture."""


class UnknownFormat(UnreadableImage):
    """No image file of this kind can be decoded here, which says nothing about the file."""


class WrongSize(InputError):
    """An image does not have the size that its camera states."""


class WrongBitDepth(InputError):
    """An image has another bit depth than its noise model."""


class BadValue(InputError):
    """A setting in a file has an impossible value."""


class UnknownKey(BadValue):
    """A file has a key that is not read, most often a misspelt one."""


class ArrangementError(InputError):
    """Pictures are no views from a grid, or do not tell which."""


class NotOneScene(ArrangementError):
    """Pictures show different scenes, or nothing that they share."""


class CopiedPicture(ArrangementError):
    """One picture is there under several names."""


class AmbiguousOrder(ArrangementError):
    """Two orders of the views are equally likely, and nothing states which."""


class ShuffledPictures(ArrangementError):
    """Neighbours by the names fit one another no better than other pictures of the set."""


class CameraTurned(ArrangementError):
    """The camera turned, or its focal length changed, from view to view."""


class ResultDamaged(InputError):
    """A result, a file beside it or one of its inputs is not what its record says."""


class OutputExists(InputError):
    """The folder to write already holds something."""


class OutputBusy(InputError):
    """Another command is writing into the folder of results."""


class MissingPackage(InputError):
    """A command needs a package that is an extra, and not installed."""


def import_optional(name: str, extra: str, alternative: str = "") -> Any:
    """Return a module of a package that an extra of faintfield installs.

    Raises MissingPackage without the package; `alternative` is what else helps.
    """
    try:
        return import_module(name)
    except ImportError as failure:
        package, otherwise = name.partition(".")[0], f", or {alternative}" if alternative else ""
        raise MissingPackage(
            f"{package} is not installed; it is an extra: pip install 'faintfield[{extra}]'{otherwise}"
        ) from failure


class ClusterFailed(InputError):
    """The workers of a cluster cannot be reached, or died; the planes they finished are kept."""


class MemoryShort(InputError):
    """A task needs more memory than is free."""


class FileFailed(InputError):
    """The system could not read, write or find out about a file where no command expects it."""


class CannotWrite(InputError):
    """A result cannot be written; no half-written file is left behind."""


class DiskFull(CannotWrite):
    """The disk has no room for a result; no half-written file is left behind."""


class WrongUsage(Exception):
    """The options of a command contradict one another; exit code 2, unlike an InputError."""


# Failures that a user can mend: the launcher prints one line and exits with code 1.
NAMED_FAILURES = (RigError, CalibrationError, ReconstructionError, InputError)
