"""Hold-out: whether a geometry found without a board explains that board."""

import numpy as np

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.geometry.bundle import Bundle, fit_boards, solve_again
from faintfield.calib.geometry.observations import Observations


def holdout_ratio(bundle: Bundle, observations: Observations) -> float | None:
    """Return the residual of boards left out over the residual of the fit, √(Σ held out² / Σ fitted²).

    Each board as it stood is left out in turn; lens and cameras are found from the others, and only its own six
    numbers are then fitted to it. Near 1 the model is right and determined; a lens that does not fit, boards of
    different size or a board that moved make it larger. None where a node would lose its only board.

    Raises
    ------
    NotIdentifiable
        Without one of the boards nothing can be solved.
    """
    if len(observations.targets) < 2:
        return None
    held_out, fitted = 0.0, 0.0
    residuals = bundle.residuals()
    for target in range(len(observations.targets)):
        others = observations.target_of != target
        if len(set(observations.node_of[others].tolist())) < len(observations.nodes):
            continue  # some node saw this board alone
        try:
            without = solve_again(bundle, observations, others)
        except RuntimeError as failure:
            name = observations.targets[target].board
            raise NotIdentifiable(
                f"without board '{name}' the geometry cannot be solved ({failure}); show more boards"
            ) from failure
        refitted = fit_boards(bundle, without, observations, ~others)
        held_out += float(np.sum(refitted.residuals() ** 2))
        fitted += float(np.sum(residuals[~others] ** 2))
    return float(np.sqrt(held_out / fitted)) if fitted else None
