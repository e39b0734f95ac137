"""Options of planes in Python: checked as those of commands are, and with a penalty and a prior of one's own."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any, Literal, TypedDict, cast, get_args

import numpy as np

from faintfield.pipelines.arguments import Method, PriorName
from faintfield.pipelines.errors import BadValue, InputError, WrongUsage
from faintfield.pipelines.reconstruction.planes.custom import CustomOptions
from faintfield.pipelines.reconstruction.request import WITH_PRIOR
from faintfield.recon.errors import ReconstructionError
from faintfield.recon.names import LikelihoodName, PenaltyName
from faintfield.recon.prior.denoiser import Denoiser
from faintfield.recon.solver.custom_penalty import ProximalPenalty

# Words that options can be, and least numbers.
_WORDS: dict[str, tuple[str, ...]] = {
    "method": get_args(Method.__value__),
    "prior": get_args(PriorName.__value__),
    "penalty": get_args(PenaltyName.__value__),
    "likelihood": ("auto", *get_args(LikelihoodName.__value__)),
}
_LEAST = {"penalty_weight": 0.0, "pitch": 1e-9, "passes": 1}

# An option of commands in a message, with the form of its value; arguments that have other names in Python.
_OPTION = re.compile(r"(?<![^\s(])--([a-z-]+)( [A-Z:]*:[A-Z:]*| NUMBER)?")
_ARGUMENTS = {
    **{"depth": "depths", "depth-mm": "depths", "pitch-mm": "pitch", "out": "out"},
    **{"sweep": "find_depths(depth_range)", "depth-range-mm": "depth_range", "disparity-range-px": "depth_range"},
}


class PlaneOptions(TypedDict, total=False):
    """Options of reconstructed planes; those of `faintfield reconstruct` by the same names.

    Attributes
    ----------
    method : str
        "pmlem" by default; "backprojection", "mlem", "pmlem-osl", or of all planes together "joint" or "occlusion".
    prior : str or Denoiser
        "tv", "patches", "learned", "auto" (the default with total variation), or a function that removes noise.
    penalty : str or ProximalPenalty
        "tv" by default, "huber-tv", "quadratic", "none", or an object with `value` and `prox`.
    penalty_weight : float
        β; by default the one that best predicts held-out views.
    likelihood : str
        "poisson-gaussian", "shifted-poisson", "poisson" or "least-squares"; by default the first or second.
    uncertainty : bool
        Also return the standard deviation of each sample.
    pitch : float
        Distance of samples in mm; by default one pixel of the reference view.
    passes : int
        Largest number of passes over the data.
    progress : callable
        Is called with the number of steps done and that of all.

    Examples
    --------
    The same options for several calls:

    >>> from faintfield import PlaneOptions
    >>> quick = PlaneOptions(prior="tv", passes=10)
    >>> quick | PlaneOptions(uncertainty=True)
    {'prior': 'tv', 'passes': 10, 'uncertainty': True}
    """

    method: Method
    prior: PriorName | Denoiser
    penalty: PenaltyName | ProximalPenalty
    penalty_weight: float | Literal["auto"]
    likelihood: LikelihoodName | Literal["auto"]
    uncertainty: bool
    pitch: float
    passes: int
    progress: Callable[[int, int], object]


def checked_options(options: PlaneOptions) -> PlaneOptions:
    """Return the options that are given; refuse unknown ones (TypeError), and impossible values (BadValue)."""
    options = cast(PlaneOptions, {name: value for name, value in options.items() if value is not None})
    if unknown := sorted(options.keys() - PlaneOptions.__optional_keys__):
        known = ", ".join(sorted(PlaneOptions.__optional_keys__))
        raise TypeError(f"{unknown[0]}: is no option of planes; they are {known}")
    values: dict[str, Any] = {**options}
    for name, words in _WORDS.items():
        if isinstance(value := values.get(name, words[0]), str) and value not in words:
            raise BadValue(f"{name}: got {value!r}; give one of {', '.join(words)}")
    for name, least in _LEAST.items():
        value = values.get(name, least)
        if not (name == "penalty_weight" and value == "auto") and not _is_number(value, least, whole=name == "passes"):
            kind = "whole number" if name == "passes" else "number"
            raise BadValue(f"{name}: got {value!r}; give a {kind} of at least {least:g}")
    penalty = values.get("penalty", "tv")
    if isinstance(penalty, type):
        raise BadValue(f"penalty: got the class {penalty.__name__}; give an object of it, {penalty.__name__}(…)")
    if not isinstance(penalty, str) and not {"value", "prox"} <= {*dir(penalty)}:
        raise BadValue(f"penalty: a {type(penalty).__name__} has no `value` and `prox`; see faintfield.ProximalPenalty")
    if not callable(progress := values.get("progress", print)):
        raise BadValue(f"progress: a {type(progress).__name__} cannot be called; give a function, such as print")
    if not isinstance(prior := values.get("prior", "tv"), str) and not callable(prior):
        raise BadValue(f"prior: a {type(prior).__name__} cannot be called; see faintfield.Denoiser")
    own = [name for name in ("penalty", "prior") if not isinstance(values.get(name, ""), str)]
    if own and values.get("method", "pmlem") not in WITH_PRIOR:
        raise BadValue(f"{own[0]}: one of your own is for {', '.join(sorted(WITH_PRIOR))}, got {values['method']}")
    return options


def _named(option: re.Match[str]) -> str:
    """Return the argument that takes the place of an option of commands; the option itself where there is none."""
    name = option[1].replace("-", "_")
    return _ARGUMENTS.get(option[1], name if name in PlaneOptions.__optional_keys__ else option[0])


@contextmanager
def naming_arguments() -> Iterator[None]:
    """Name arguments instead of the options of commands in the messages of failures; a wrong usage is a BadValue."""
    try:
        yield
    except (InputError, ReconstructionError, WrongUsage) as failure:
        text = _OPTION.sub(_named, str(failure))
        if text == str(failure) and not isinstance(failure, WrongUsage):
            raise
        raise (BadValue if isinstance(failure, WrongUsage) else type(failure))(text) from failure


def _is_number(value: object, least: float, *, whole: bool) -> bool:
    return isinstance(value, Integral if whole else Real) and least <= float(value) < np.inf


def solver_options(options: PlaneOptions) -> CustomOptions:
    """Return the options of solvers; a penalty or prior that is an object goes to a field of its own."""
    penalty, prior = options.get("penalty", "tv"), options.get("prior")
    custom_penalty = None if isinstance(penalty, str) else penalty
    denoiser = None if prior is None or isinstance(prior, str) else prior
    named_prior = prior if isinstance(prior, str) else None
    if custom_penalty is not None and (denoiser is not None or named_prior not in (None, "tv")):
        raise BadValue("prior: it starts from total variation, not from a penalty of one's own; leave one out")
    if custom_penalty is not None and options.get("uncertainty"):
        raise BadValue("uncertainty: nobody knows the errors under a penalty of one's own; leave it out")
    return CustomOptions(
        penalty=penalty if isinstance(penalty, str) else "tv",
        prior="tv" if custom_penalty is not None or denoiser is not None else named_prior,
        penalty_weight=options.get("penalty_weight", "auto"),
        likelihood=options.get("likelihood", "auto"),
        uncertainty=options.get("uncertainty", False),
        passes=options.get("passes"),
        custom_penalty=custom_penalty,
        denoiser=denoiser,
    )
