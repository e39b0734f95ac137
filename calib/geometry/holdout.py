"""Hold-out validation: whether a geometry found without a board explains that board."""

import numpy as np

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.geometry.bundle import Bundle, fit_boards, solve_again
from faintfield.calib.geometry.observations import Observations


def holdout_ratio(bundle: Bundle, observations: Observations) -> float | None:
    """Return the ratio of the residual of boards left out to that of the fit, √(Σ held out² / Σ fitted²).

    Each target (a board in a sweep) is left out in turn. Lens and cameras are found from the others, then only the
    pose of that board is fitted to its corners. A ratio near 1 says that the model is right and determined; a wrong
    lens model, boards of different sizes, or a board that moved increase it. A target that some node sees alone is
    not left out; None if that holds for all.

    Raises
    ------
    NotIdentifiable
        There is no solution without one of the boards.
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
