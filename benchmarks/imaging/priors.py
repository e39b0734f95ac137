"""Planes by priors against total variation and BM3D: `python -m benchmarks.imaging.priors`.

The four toys of figure 4, with its exposures and its errors: one line of JSON for each plane, then tables of the mean
square errors over the draws, of bright specks in the dark, and of the residuals where there is nothing to see. With
`--bm3d PYTHON`, a Python that has the package `bm3d`, the peer denoises the same back-projections, each with the σ
that the truth shows to be best. `--picture FILE` draws the planes of the first draw, one file for each SNR.
"""

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.imaging.bm3d_peer import Bm3d
from benchmarks.imaging.prior_faults import BANDS, Residual, dark_samples, residuals_of_fields, specks
from benchmarks.imaging.prior_pictures import ShownPlane, draw
from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.paper.figure4 import SNRS, StagedObject, stage_object
from faintfield.pipelines.reconstruction.planes.penalised import Solution
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.solver.initialization import back_projection
from faintfield.rig.simulation.objects import sailing_boat, shaded_ball, toy_airplane, toy_truck

PRIORS: tuple[PriorName, ...] = ("tv", "patches", "auto")
_PEER = "BM3D"
_MAKERS = (toy_truck, toy_airplane, sailing_boat, shaded_ball)
_SIZE_PX, _FIELD_PX, _DEPTH_MM = (640, 480), (320, 240), 600.0
_SHOWN = ("tv", _PEER, "auto")

# Specks are also counted above this share of white, where an eye finds them, and this near an object and the rim.
_BRIGHT, _NEAR_SAMPLES, _RIM_SAMPLES = 0.1, 8, 2


@dataclass(frozen=True)
class Specks:
    """Bright specks in the dark of one plane, in samples.

    Attributes
    ----------
    bright : int
        Those of more than a tenth of white.
    beside : int
        Those within eight samples of the object.
    rim : int
        Those in the two outermost rows and columns of the plane.
    proposed : int, optional
        Those of which the proposal of a prior has at least half the light; the data brought the others.
    """

    all: int
    bright: int
    beside: int
    rim: int
    proposed: int | None


@dataclass(frozen=True)
class Outcome:
    """One plane: of an object at an SNR, from one draw of the noise, by one method."""

    object: str
    snr: float
    seed: int
    method: str
    mse: float
    mse_texture: float
    specks: Specks


@dataclass
class Bench:
    """The comparison, and what a picture of it shows.

    Attributes
    ----------
    bm3d : Bm3d, optional
        The peer, if there is one.
    sigmas_e : dict of (float, str) to float
        Its σ, the best for the first draw, by SNR and object.
    shown : dict of (float, str) to list of ShownPlane
        The planes of the first draw, likewise.
    """

    bm3d: Bm3d | None = None
    sigmas_e: dict[tuple[float, str], float] = field(default_factory=dict)
    shown: dict[tuple[float, str], list[ShownPlane]] = field(default_factory=dict)

    def outcomes(self, snrs: Sequence[float], seeds: int) -> Iterator[Outcome]:
        """Yield the outcomes of all objects, draws, SNRs and methods."""
        for make in _MAKERS:
            stage = stage_object(make(0.0, 0.0, _DEPTH_MM).grey(), _SIZE_PX)
            for seed in range(1, seeds + 1):
                for snr, images, scale_e in (exposure for exposure in stage.exposures(seed) if exposure[0] in snrs):
                    made = self._solutions(stage, snr, images, scale_e)
                    yield from _judged(stage, snr, seed, made, scale_e)
                    if seed == 1:
                        self.shown[snr, stage.name] = _row(stage, made, scale_e)

    def _solutions(
        self, stage: StagedObject, snr: float, images: ElementalImages, scale_e: float
    ) -> dict[str, Solution]:
        """Return the plane of an exposure by each method."""
        made: dict[str, Solution] = {
            prior: solve(stage.operator, images, "pmlem", SolverOptions(prior=prior, proposal=True)) for prior in PRIORS
        }
        if self.bm3d is not None:
            picture, case = back_projection(stage.operator, images), (snr, stage.name)
            if case not in self.sigmas_e:
                self.sigmas_e[case] = self.bm3d.best_sigma_e(
                    picture, lambda estimate: stage.errors(estimate, scale_e)[0]
                )
            made[_PEER] = Solution(self.bm3d.denoised(picture, self.sigmas_e[case]), made["tv"].record)
        return made


def _judged(stage: StagedObject, snr: float, seed: int, made: dict[str, Solution], scale_e: float) -> Iterator[Outcome]:
    """Yield the outcome of each method; σ of specks is that of total variation's plane in the dark."""
    sigma_e = float(made["tv"].plane[dark_samples(stage)].std())
    for method, solution in made.items():
        found = counted(stage, solution, sigma_e, scale_e)
        yield Outcome(stage.name, snr, seed, method, *stage.errors(solution.plane, scale_e), found)


def counted(stage: StagedObject, solution: Solution, sigma_e: float, scale_e: float) -> Specks:
    """Count the specks of a plane."""
    plane = solution.plane
    proposal = solution.sidecars.get("proposal")
    found = specks(plane, dark_samples(stage), sigma_e)
    rim = np.ones(found.shape, bool)
    rim[_RIM_SAMPLES:-_RIM_SAMPLES, _RIM_SAMPLES:-_RIM_SAMPLES] = False
    return Specks(
        all=_count(found),
        bright=_count(found & (plane > _BRIGHT * scale_e)),
        beside=_count(found & _near_object(stage)),
        rim=_count(found & rim),
        proposed=None if proposal is None else _count(found & (proposal >= plane / 2)),
    )


def _count(samples: NDArray[np.bool_]) -> int:
    """Return how many samples are true."""
    return int(np.count_nonzero(samples))


def _near_object(stage: StagedObject) -> NDArray[np.bool_]:
    """Return the samples (row, column) within some samples of the object."""
    size = 2 * _NEAR_SAMPLES + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(stage.region[stage.window].astype(np.uint8), disk) > 0)


def _row(stage: StagedObject, made: dict[str, Solution], scale_e: float) -> list[ShownPlane]:
    """Return what a picture shows of one object: planes with their errors, and the object itself."""
    region = stage.region[stage.window]
    white = float(stage.texture[region].max())
    row = []
    for method in _SHOWN:
        if method in made:
            mse, mse_texture = stage.errors(made[method].plane, scale_e)
            title = f"{method}: {1e3 * mse:.2f} ({1e3 * mse_texture:.2f})"
            row.append(ShownPlane(made[method].plane / (scale_e * white), title))
    return [*row, ShownPlane(stage.texture / white, stage.name)]


def error_table(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a Markdown table of errors x 1000, the mean over the draws: `mse / mse_texture`."""
    objects, methods = _names(outcome.object for outcome in outcomes), _names(outcome.method for outcome in outcomes)
    lines = [
        "| MSE / `mse_texture`, ×1000 | " + " | ".join([*objects, "mean"]) + " |",
        "|---" * (len(objects) + 2) + "|",
    ]
    for snr in sorted({outcome.snr for outcome in outcomes}):
        for method in methods:
            own = [outcome for outcome in outcomes if (outcome.snr, outcome.method) == (snr, method)]
            groups = [[outcome for outcome in own if outcome.object == name] for name in objects]
            means = [
                np.mean([(1e3 * outcome.mse, 1e3 * outcome.mse_texture) for outcome in group], axis=0)
                for group in groups
            ]
            cells = (f"{mse:.2f} / {texture:.2f}" for mse, texture in [*means, np.mean(means, axis=0)])
            lines.append(f"| SNR {snr:g}: {method} | " + " | ".join(cells) + " |")
    return lines


def speck_table(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a Markdown table of specks, summed over objects and draws."""
    lines = ["| specks | all | > 0.1 of white | beside the object | on the rim | in the proposal |", "|---" * 6 + "|"]
    for snr in sorted({outcome.snr for outcome in outcomes}):
        for method in _names(outcome.method for outcome in outcomes):
            counts = [outcome.specks for outcome in outcomes if (outcome.snr, outcome.method) == (snr, method)]
            sums = np.sum([[count.all, count.bright, count.beside, count.rim] for count in counts], axis=0).tolist()
            proposed = "–" if counts[0].proposed is None else sum(count.proposed or 0 for count in counts)
            lines.append(f"| SNR {snr:g}: {method} | " + " | ".join(str(count) for count in (*sums, proposed)) + " |")
    return lines


def residual_table(residuals: Sequence[Residual]) -> list[str]:
    """Return a Markdown table of residuals, in the order given."""
    bands = [f"{low:.2f}–{high:.2f}" for low, high in pairwise(BANDS)]
    head = ["residual", "rms, σ", "largest pattern, σ", "in σ of tv's", *bands]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for residual in residuals:
        cells = [f"{value:.2g}" for value in (residual.rms, residual.pattern, residual.pattern_of_tv, *residual.bands)]
        lines.append(f"| {residual.field}: {residual.method} | " + " | ".join(cells) + " |")
    return lines


def _names(names: Iterable[str]) -> list[str]:
    """Return names once each, in the order of their first appearance."""
    return list(dict.fromkeys(names))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.priors", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="draws of the noise")
    parser.add_argument("--snr", type=float, nargs="+", choices=SNRS, default=[SNRS[0], SNRS[-1]])
    parser.add_argument("--bm3d", type=Path, metavar="PYTHON", help="Python of an environment with the package bm3d")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="PNG to draw; its name gets the SNR")
    parser.add_argument("--fields", action="store_true", help="only the residuals where there is nothing to see")
    options = parser.parse_args()
    if not options.fields:
        bench, outcomes = Bench(Bm3d(options.bm3d) if options.bm3d else None), []
        for outcome in bench.outcomes(options.snr, options.seeds):
            outcomes.append(outcome)
            print(json.dumps(asdict(outcome)), flush=True)
        for snr in options.snr if options.picture else ():
            rows = [row for (of_snr, _), row in bench.shown.items() if of_snr == snr]
            draw(options.picture.with_stem(f"{options.picture.stem}_{snr:g}"), rows)
        print("\n".join(["", *error_table(outcomes), "", *speck_table(outcomes)]))
        for (snr, name), sigma_e in bench.sigmas_e.items():
            print(f"σ of {_PEER}, {name} at SNR {snr:g}: {sigma_e:.2f} e⁻")
    print("\n".join(["", *residual_table(list(residuals_of_fields(PRIORS, _FIELD_PX, 1)))]))


if __name__ == "__main__":
    main()
