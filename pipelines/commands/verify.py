"""`faintfield verify`: sessions against their journals, and results against their records and inputs."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from faintfield.pipelines.workflows.verify import Verified

type Result = Verified


def verify(path: Path, /, *, inputs: Path | None = None) -> Result:
    """Verify a session or results without changing a byte of them.

    Of a session: its plan, its journal and the SHA-256 of every frame, then the results in its folder. Of results:
    every record against its own digest, the files that it vouches for, and the inputs that it was made from.

    Parameters
    ----------
    path
        A session, a folder of results, or one record such as noise.json, geometry.json or reconstruction.json.
    inputs
        Folder of the session or set that the results were made from; searched for around them by default. Inputs that
        are not found are named as not checked, which is no failure.
    """
    from faintfield.pipelines.workflows.verify import verify_folder

    return verify_folder(path, inputs)
