# mypy: disable-error-code="no-untyped-def"
"""The pixel models as a compiled function of arrays."""

from faintfield.recon.likelihood.pixel_models import form_ratio_of_block
from faintfield.recon.numba_tools import compiled, index, pointer


@compiled
def form_ratio(model, expected, observed, background, variance, response, level, work):
    """Replace H f of some pixels by the ratio; return their negative log-likelihood.

    `work` is scratch of shape (WORK_ROWS, pixels or more); all other arrays have one number per pixel.
    """
    maps = pointer(observed), pointer(background), pointer(variance), pointer(response)
    return form_ratio_of_block(model, index(expected.size), pointer(expected), *maps, level, pointer(work), True)
