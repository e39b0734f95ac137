"""The failures of files and folders given to a command, one tree: catch `InputError` to catch them all.

InputError
├── MissingFile
├── UnreadableImage
├── WrongSize
├── WrongBitDepth
├── BadValue
│   └── UnknownKey
├── OutputExists
├── OutputBusy
├── MissingPackage
├── ClusterFailed
├── MemoryShort
└── CannotWrite
    └── DiskFull

WrongUsage

Every message says what is wrong, the value found, the limit it broke, and what to do.
"""

from faintfield.calib.errors import CalibrationError
from faintfield.recon.errors import ReconstructionError
from faintfield.rig.errors import RigError


class InputError(Exception):
    """A file or folder given to a command cannot be used."""


class MissingFile(InputError):
    """A file or folder that is named does not exist."""


class UnreadableImage(InputError):
    """An image file cannot be decoded, or holds something else than was promised."""


class WrongSize(InputError):
    """An image does not have the size that its camera states."""


class WrongBitDepth(InputError):
    """An image has another bit depth than its noise model."""


class BadValue(InputError):
    """A setting in a file has a value that cannot be."""


class UnknownKey(BadValue):
    """A file has a key that nothing reads: most often a misspelt one."""


class OutputExists(InputError):
    """The place to write to holds something already."""


class OutputBusy(InputError):
    """Another command is writing into the folder of results."""


class MissingPackage(InputError):
    """A command needs a package that is not installed with the rest."""


class ClusterFailed(InputError):
    """The workers that were to do the tasks cannot be reached, or died; what they finished is kept."""


class MemoryShort(InputError):
    """What was asked for needs more memory than is free."""


class CannotWrite(InputError):
    """A result could not be written; nothing half-written is left behind."""


class DiskFull(CannotWrite):
    """The disk has no room for the result; nothing half-written is left behind."""


class WrongUsage(Exception):
    """The options of a command do not make sense together; exit code 2, unlike an InputError."""


# What a user can mend: the launcher says it in one line and ends with exit code 1.
NAMED_FAILURES = (RigError, CalibrationError, ReconstructionError, InputError)
