"""`faintfield figures`: figures 2, 3 and 4 of the paper from the simulated rig, with their numbers."""

from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Positive, Seed, SizePx
from faintfield.pipelines.choices import FigureNumber
from faintfield.pipelines.paper.figure_records import Figure2, Figure3, Figure4


class FiguresMade(msgspec.Struct, frozen=True):
    """The result of `faintfield figures`."""

    out: str
    report: str
    figures: dict[str, Figure2 | Figure3 | Figure4]


def figures(
    out: Path,
    /,
    *,
    only: Annotated[list[FigureNumber] | None, Parameter(consume_multiple=True)] = None,
    snr: Positive = 0.16,
    seed: Seed = 1,
    seeds: Count = 5,
    size_px: SizePx = (640, 480),
) -> FiguresMade:
    """Make figures 2, 3 and 4 of the paper from simulated light, and a page that compares them with the paper's.

    Figure 2: the bright integral image and its back-projections. Figure 3: one dark view, the noise reference, and the
    planes found by penalised maximum likelihood. Figure 4: the error against the SNR for four objects. Each figure is a
    PNG with its numbers as JSON and CSV; figures.html shows all figures that are in OUT.

    Parameters
    ----------
    out
        Folder to write; figures of an earlier call stay unless they are made again.
    only
        Figures to make; all by default.
    snr
        SNR of the dark views of figure 3, eq. (4).
    seed
        Seed of the random generator, for figures 2 and 3.
    seeds
        Draws of the noise for each point of figure 4.
    size_px
        Width and height of the detector.
    """
    from faintfield.pipelines.paper.figures import PAGE_FILE, FigureOptions, make_figures

    options = FigureOptions(only=sorted(set(only or (2, 3, 4))), snr=snr, seed=seed, seeds=seeds, size_px=size_px)
    made = make_figures(out, options)
    return FiguresMade(str(out), str(out / PAGE_FILE), made)
