"""Request and result of planes: settings, and solutions with their records."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from faintfield.pipelines.arguments import PriorName as PriorName
from faintfield.pipelines.formats.results.records import SolveRecord
from faintfield.recon.likelihood.images import Image, LikelihoodName
from faintfield.recon.solver.penalties import PenaltyName


@dataclass(frozen=True)
class Settings:
    """Settings of the reconstruction of planes.

    Attributes
    ----------
    penalty_weight : float, optional
        β; chosen from the data if None: by held-out views for PMLEM, from the noise level for one-step-late.
    passes : int, optional
        Largest number of passes over the data; the method's own limit if None.
    likelihood : str
        Model of the pixels; "auto" chooses by their read noise.
    penalty : str
        Penalty of PMLEM; one-step-late always takes the smoothed total variation of eq. (3).
    uncertainty : bool
        Estimate the standard deviation of the samples of PMLEM's planes.
    prior : str
        What is expected of a picture besides small differences: "tv", nothing; "patches", that its patches repeat;
        "learned", what a network was trained with; "auto", whichever predicts best.
    proposal : bool
        Keep the proposal of the prior beside the plane, and how far the data moved the plane from it.
    """

    penalty_weight: float | None = None
    passes: int | None = None
    likelihood: LikelihoodName | Literal["auto"] = "auto"
    penalty: PenaltyName = "tv"
    uncertainty: bool = False
    prior: PriorName = "tv"
    proposal: bool = False


@dataclass(frozen=True)
class Solution:
    """One colour of a plane.

    Attributes
    ----------
    plane : float array (row, column)
        In expected electrons.
    record : SolveRecord
        How it was solved.
    sidecars : dict of str to float array (row, column)
        What else is known of each sample: `sigma`, its standard deviation in electrons; `opacity`, 0 to 1;
        `proposal`, in electrons, of a prior; `moved`, the plane less the proposal in standard deviations of the noise.
    """

    plane: Image
    record: SolveRecord
    sidecars: dict[str, Image] = field(default_factory=dict)


@dataclass(frozen=True)
class Pilot:
    """Start of the prior of one colour.

    Attributes
    ----------
    solution : Solution
        The plane of total variation.
    other_colours : float array (row, column)
        The sum of the same plane in the other colours, in electrons.
    """

    solution: Solution
    other_colours: Image


def mean_e(plane: Image) -> float:
    """Return the mean of a plane, summed in float64."""
    return float(np.mean(plane, dtype=np.float64))
