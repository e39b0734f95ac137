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
    """A file or folder does not exist, or cannot be read.

    The message has file and key; correct the name.

    A message that names `faintfield import grid`: a folder of pictures is named where a set is wanted. Make a set of
    them first, and name that.
    """


class UnreadableImage(InputError):
    """An image file cannot be decoded, or does not hold one picture.

    Export raw or 16 bits, with the same region of interest throughout.
    """


class UnknownFormat(UnreadableImage):
    """No image file of this kind can be decoded here, which says nothing about the file.

    Save TIFF, PNG or DNG; convert raw files of a camera that is too new for LibRaw to DNG.
    """


class WrongSize(InputError):
    """An image does not have the size that its camera states.

    Export all images with the same region of interest.
    """


class WrongBitDepth(InputError):
    """An image has another bit depth than its noise model.

    Export raw or 16 bits.
    """


class BadValue(InputError):
    """A setting in a file has an impossible value.

    The message has file, key, value and limit; correct the value.
    """


class UnknownKey(BadValue):
    """A file has a key that is not read, most often a misspelt one.

    The message has file and key, and for a misspelt key the nearest known key.
    """


class ArrangementError(InputError):
    """Pictures are no views from a grid, or do not tell which.

    The group of the failures below, each of which has its remedy (docs/how-to/import_pictures.md).
    """


class NotOneScene(ArrangementError):
    """Pictures show different scenes, or nothing that they share.

    Give views of one scene, each from its own place.
    """


class CopiedPicture(ArrangementError):
    """One picture is there under several names.

    Give views of one scene, each from its own place.
    """


class AmbiguousOrder(ArrangementError):
    """Two orders of the views are equally likely, and nothing states which.

    No hidden parts tell near from far, or a square and one line fit alike. Give the options that the message names,
    `--flip-rows` or `--flip-columns`, `--disparity-px`, or `--rows` and `--columns`.
    """


class ShuffledPictures(ArrangementError):
    """Neighbours by the names fit one another no better than other pictures of the set.

    Give the pictures in the order of the grid: by their names, `--pattern`, or `--rows` and `--columns`.
    """


class CameraTurned(ArrangementError):
    """The camera turned, or its focal length changed, from view to view.

    Names and a pitch do not give the pose of such a view. Calibrate the cameras, for example with COLMAP: `faintfield
    import colmap`.
    """


class ResultDamaged(InputError):
    """A result, a file beside it or one of its inputs is not what its record says.

    `faintfield verify` lists the files; restore them from a copy, or make the result again.
    """


class OutputExists(InputError):
    """The folder to write already holds something.

    Give another folder, or `--overwrite`. A depth map and a surface, whose files have the same names, cannot share a
    folder.
    """


class OutputBusy(InputError):
    """Another command is writing into the folder of results.

    Wait for it, or give another `--out`.
    """


class MissingPackage(InputError):
    """A command needs a package that is an extra, and not installed.

    The message gives the `pip install` command.
    """


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
    """The workers of a cluster cannot be reached, or died; the planes they finished are kept.

    Check that the scheduler runs, its address, and the logs; with `--workers`, the memory; then the same command
    resumes (docs/how-to/sweep_many_planes.md).
    """


class MemoryShort(InputError):
    """A task needs more memory than is free.

    Most often it is needed by `--joint` or `--occlusion`. Use fewer planes, a larger `--pitch-mm`, or `--method pmlem`.
    """


class FileFailed(InputError):
    """The system could not read, write or find out about a file where no command expects it.

    A worn disk, a lost network drive, or a right taken away meanwhile. See to the disk, and run the same command again.
    """


class CannotWrite(InputError):
    """A result cannot be written; no half-written file is left behind.

    Make room, or write elsewhere.
    """


class DiskFull(CannotWrite):
    """The disk has no room for a result; no half-written file is left behind.

    Make room, or write elsewhere.
    """


class WrongUsage(Exception):
    """The options of a command contradict one another; exit code 2, unlike an InputError.

    See `faintfield COMMAND --help`.
    """


# Failures that a user can mend: the launcher prints one line and exits with code 1.
NAMED_FAILURES = (RigError, CalibrationError, ReconstructionError, InputError)
