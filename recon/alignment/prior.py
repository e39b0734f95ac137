"""Errors of poses before the views are looked at: of each node, of the stage, of homings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.alignment.cameras import POSE

# Least and most of an estimated variance relative to where it starts; most of that of drifts.
_LEAST, _MOST, _MOST_DRIFT = 1e-6, 1e3, 1.0


class MeasurementErrors(NamedTuple):
    """Standard deviations of what changed since poses were measured: rotations, translations, shifts of a homing."""

    sigma_rad: float
    sigma_mm: float
    homing_mm: float


@dataclass(frozen=True)
class PosePrior:
    """Normal errors of all poses but the reference's, parts of whose covariance are estimated from the views.

    Attributes
    ----------
    known : float array (parameter, parameter)
        Covariance that is known, such as that of a measurement by boards.
    shapes : tuple of float array (parameter, parameter)
        Further covariances, each for a variance of 1.
    variances, limits : float array (shape,), (shape, 2)
        Their variances, and the limits between which these are estimated.
    ranks : tuple of int
        Ranks of the shapes.
    """

    known: NDArray[np.float64]
    shapes: tuple[NDArray[np.float64], ...]
    variances: NDArray[np.float64]
    limits: NDArray[np.float64]
    ranks: tuple[int, ...]

    @classmethod
    def of_grid(cls, nodes: NDArray[np.intp], reference: int, sigma_rad: float, sigma_mm: float) -> "PosePrior":
        """Return the prior of views at nodes (view, 2) whose poses are those of a regular grid.

        Each pose has rotations and translations of its own, and all together a drift: a change linear in row and
        column, as by a wrong scale or a bent rail, which is as large at the end of a row or column.
        """
        others = np.delete(np.arange(len(nodes)), reference)
        away = (nodes[others] - nodes[reference]) / np.maximum(np.ptp(nodes, axis=0), 1)
        rotations = np.diag([1.0, 1, 1, 0, 0, 0])
        parts = [
            (of_views, of_pose)
            for of_views in (np.eye(len(others)), away @ away.T)
            for of_pose in (rotations, np.eye(POSE) - rotations)
        ]
        start = np.array([sigma_rad**2, sigma_mm**2] * 2)
        most = np.array([_MOST, _MOST, _MOST_DRIFT, _MOST_DRIFT])
        return cls._of(
            np.zeros((POSE * len(others),) * 2), parts, start, np.column_stack([_LEAST * start, most * start])
        )

    @classmethod
    def of_measurement(
        cls, covariance: NDArray[np.float64], groups: Sequence[int], reference: int, errors: MeasurementErrors
    ) -> "PosePrior":
        """Return the prior of poses that were measured with some covariance, and may have changed since.

        Each group of views, such as those between two homings, has a shift of its own, and each view a small change.
        """
        others = np.delete(np.asarray(groups), reference)
        rotations = np.diag([1.0, 1, 1, 0, 0, 0])
        translations = np.eye(POSE) - rotations
        together = (others[:, np.newaxis] == others) & (others != groups[reference])
        parts = [(np.eye(len(others)), rotations), (np.eye(len(others)), translations)]
        if together.any():
            parts.append((together.astype(float), translations))
        start = np.square(errors)[: len(parts)]
        return cls._of(covariance, parts, start, np.column_stack([_LEAST * start, _MOST * start]))

    @classmethod
    def _of(
        cls,
        known: NDArray[np.float64],
        parts: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
        start: NDArray[np.float64],
        limits: NDArray[np.float64],
    ) -> "PosePrior":
        ranks = tuple(int(np.linalg.matrix_rank(views) * np.linalg.matrix_rank(pose)) for views, pose in parts)
        return cls(
            known, tuple(np.asarray(np.kron(views, pose), np.float64) for views, pose in parts), start, limits, ranks
        )

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of a pose's own rotations."""
        return float(np.sqrt(self.variances[0]))

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of a pose's own translations."""
        return float(np.sqrt(self.variances[1]))

    def precision(self) -> NDArray[np.float64]:
        """Return the inverse of the covariance (parameter, parameter)."""
        covariance = self.known.copy()
        for variance, shape in zip(self.variances, self.shapes, strict=True):
            covariance += variance * shape
        return np.linalg.inv(covariance)

    def updated(self, error: NDArray[np.float64], covariance: NDArray[np.float64]) -> "PosePrior":
        """Return the prior with its variances after a step of expectation maximisation.

        `error` and `covariance` are the mean (parameter,) and covariance of the errors given the views. With P the
        precision and K a shape of rank n, `θ ← θ + θ²/n · tr( K (P E[εεᵀ] P − P) )`.
        """
        precision = self.precision()
        pulled = precision @ error
        change = np.outer(pulled, pulled) + precision @ covariance @ precision - precision
        variances = [
            variance + variance**2 / rank * float(np.sum(shape * change))
            for variance, shape, rank in zip(self.variances, self.shapes, self.ranks, strict=True)
        ]
        return replace(self, variances=np.clip(variances, *self.limits.T))
