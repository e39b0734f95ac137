"""Options of solvers from Python: beside those of the commands, a penalty and a denoiser of one's own."""

from dataclasses import dataclass, replace
from typing import Self

from faintfield.pipelines.arguments import SolverOptions
from faintfield.recon.prior.denoiser import Denoiser
from faintfield.recon.solver.custom_penalty import ProximalPenalty


@dataclass(frozen=True, kw_only=True)
class CustomOptions(SolverOptions):
    """Options of solvers, with a penalty in the place of `penalty`, and a denoiser in that of `prior`."""

    custom_penalty: ProximalPenalty | None = None
    denoiser: Denoiser | None = None

    @property
    def has_prior(self) -> bool:
        """Return whether more than the penalty is expected of a picture."""
        return self.denoiser is not None or super().has_prior

    def without_prior(self) -> Self:
        """Return the options of planes from which a prior begins."""
        return replace(super().without_prior(), denoiser=None)
