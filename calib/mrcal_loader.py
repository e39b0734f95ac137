"""Loading mrcal, which takes half a second and is not always installed."""

from typing import Any

from faintfield.calib.errors import MissingMrcal


def load_mrcal() -> Any:
    """Return the module mrcal.

    Raises
    ------
    MissingMrcal
        It cannot be imported.
    """
    try:
        import mrcal
    except ImportError as failure:
        raise MissingMrcal(
            f"mrcal cannot be imported ({failure}), and geometry and camera models need it; "
            "run: pip install --no-deps mrcal numpysane"
        ) from failure
    return mrcal
