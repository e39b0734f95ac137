"""`faintfield run`: everything after the capture of a session, only what is out of date."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.choices import LensName
from faintfield.pipelines.reconstruction.options import DEFAULTS, Options

if TYPE_CHECKING:
    from faintfield.pipelines.workflows.session import RunOutcome

type Result = RunOutcome


def run(
    session: Path,
    /,
    *,
    options: Options = DEFAULTS,
    lens: LensName = "opencv5",
    limit_px: Positive = 0.5,
) -> Result:
    """Do everything after the capture: noise, geometry, reconstruction, report; skip what is up to date.

    A result is up to date while its input files (by hash), its options and the versions of the software are those that
    it records. If a step fails, the results of the others are kept. Options of the reconstruction are those of
    `reconstruct`; planes are by default at the depths under [scene] in the rig.toml.

    Parameters
    ----------
    session
        Folder of the session.
    lens
        Distortion model, as for `geometry`.
    limit_px
        Largest accepted standard deviation of the transfer between views, as for `geometry`.
    """
    # Of `reconstruct`, three options have no place here: --out, as results lie in the session; --geometry, which is
    # measured; and --scene, as the page is that of the dark scene. The bright one is reconstructed by `reconstruct`
    from faintfield.pipelines.workflows.session import run_session

    return run_session(session, options, lens, limit_px)
