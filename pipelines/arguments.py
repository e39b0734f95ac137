"""Types of command-line arguments, apart from the code that acts on them: numbers within limits, words, options."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from cyclopts import Group, Parameter

from faintfield.recon.names import LikelihoodName, PenaltyName

# No quantity is larger, and computing with numbers up to it does not overflow.
_MAX_NUMBER = 1e9


def _within(minimum: float, maximum: float = _MAX_NUMBER) -> Parameter:
    """Return a parameter whose number, or each number of a tuple, must lie within limits."""

    def check(_: Any, value: float | str | tuple[float, ...] | None) -> None:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not minimum <= number <= maximum:
                limits = f"at least {minimum:g}" if number < minimum else f"a number of at most {maximum:g}"
                raise ValueError(f"Must be {limits}, got {number:g}.")

    return Parameter(validator=check)


type Count = Annotated[int, _within(1)]
type Seed = Annotated[int, _within(0)]
type Positive = Annotated[float, _within(1e-9)]
type NotNegative = Annotated[float, _within(0)]
type NotNegativeOrAuto = Annotated[float | Literal["auto"], _within(0)]
type Fraction = Annotated[float, _within(1e-9, 1)]
type SizePx = Annotated[tuple[int, int], _within(2)]

# Groups of options in help, the first first.
IN_INPUT = Parameter(group=Group("Input", sort_key=1))
IN_DEPTHS = Parameter(group=Group("Depths of planes", sort_key=2))
IN_SURFACE = Parameter(group=Group("Surface", sort_key=3))
IN_PICTURE = Parameter(group=Group("Method, and what is expected of a picture", sort_key=4))
IN_OUTPUT = Parameter(group=Group("Output", sort_key=5))
IN_MACHINE = Parameter(group=Group("Machine", sort_key=6))

type Method = Literal["pmlem", "backprojection", "mlem", "pmlem-osl", "joint", "occlusion"]
type PriorName = Literal["tv", "patches", "learned", "auto"]
type SceneKind = Literal["dark_scene", "bright"]
type FigureNumber = Literal[2, 3, 4]
type LensName = Literal["opencv5", "opencv8", "opencv4", "pinhole"]
type PaperName = Literal["A4", "A3", "A2", "letter"]
type SchemaKind = Literal[
    "rig",
    "elemental",
    "boards",
    "noise-frames",
    "plane-poses",
    "truth",
    "true-depth",
    "plan",
    "noise",
    "geometry",
    "alignment",
    "reconstruction",
    "plane",
    "depth-map",
    "surface",
    "overview",
    "metrics",
    "depth-errors",
]


@Parameter(name="*")
@dataclass(frozen=True)
class StageConnection:
    """The stage to use: a port, or the stage of a rig.toml.

    Parameters
    ----------
    port
        Serial device, pyserial URL, or simulated:grbl, simulated:grblhal, simulated:marlin.
    protocol
        Firmware of the controller at the port; grbl by default.
    baud
        Bits per second; 115200 by default.
    rig
        Use the [stage] table of this rig.toml instead, with its limits and keep-out boxes.
    """

    port: str | None = None
    protocol: Literal["grbl", "marlin"] | None = None
    baud: int | None = None
    rig: Path | None = None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Options of the light on planes and surfaces: given on the command line, solved by, and recorded.

    Parameters
    ----------
    penalty_weight
        β of the paper, in the unit of the number of views. auto: for pmlem, the weight that best predicts held-out
        views; for pmlem-osl, a weight computed from the noise level.
    penalty
        Penalty of pmlem on differences between neighbouring samples: total variation (tv), total variation with small
        differences squared (huber-tv), squared differences (quadratic), or none.
    likelihood
        Noise model of a pixel. auto: poisson-gaussian (exact) for read noise below 3 electrons, shifted-poisson
        (faster) above. poisson ignores read noise; least-squares assumes Gaussian noise of fixed variance.
    uncertainty
        Save the standard deviation of each sample beside the planes of pmlem, joint and occlusion; see
        docs/quality.md for how often its intervals hold.
    prior
        Prior of the picture. tv: total variation alone. patches: small patches repeat. learned: a small trained
        network. auto: the mixture of these that predicts held-out views best. Priors other than tv leave less noise and
        more detail, and the data keep the last word: see docs/explanation/priors.md. By default auto for pmlem, joint
        and occlusion, but tv for sweeps, which take several times as long with auto. A surface without this option has
        the picture of tv with detail added by a filter of patches.
    proposal
        Save, beside each plane or the picture of a surface, what the prior proposed, and in standard deviations how far
        the data moved it.
    passes
        Largest number of passes over the data.
    """

    penalty_weight: Annotated[NotNegativeOrAuto, IN_PICTURE] = "auto"
    penalty: Annotated[PenaltyName, IN_PICTURE] = "tv"
    likelihood: Annotated[LikelihoodName | Literal["auto"], IN_PICTURE] = "auto"
    uncertainty: Annotated[bool, IN_OUTPUT] = False
    prior: Annotated[PriorName | None, IN_PICTURE] = None
    proposal: Annotated[bool, IN_OUTPUT] = False
    passes: Annotated[Count | None, IN_PICTURE] = None

    @property
    def has_prior(self) -> bool:
        """Return whether more than total variation is expected of a picture."""
        return self.prior not in (None, "tv")

    def without_prior(self) -> Self:
        """Return the options of planes from which a prior begins."""
        return replace(self, prior="tv", uncertainty=False)
