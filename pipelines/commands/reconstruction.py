"""Commands that reconstruct planes and surfaces, and show them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import (
    IN_INPUT,
    IN_MACHINE,
    IN_OUTPUT,
    Count,
    FigureNumber,
    LensName,
    Positive,
    SceneKind,
    Seed,
    SizePx,
)
from faintfield.pipelines.console import working
from faintfield.pipelines.reconstruction.options import DEFAULTS, Options

if TYPE_CHECKING:
    from faintfield.pipelines.paper.figures import FiguresMade
    from faintfield.pipelines.reconstruction.planes.forecast import Forecast
    from faintfield.pipelines.reconstruction.run import Outcome
    from faintfield.pipelines.workflows.session import RunOutcome

type Run = RunOutcome
type Reconstruction = Outcome | Forecast
type Figures = FiguresMade


def run(
    session: Annotated[Path, IN_INPUT],
    /,
    *,
    options: Options = DEFAULTS,
    lens: Annotated[LensName, IN_INPUT] = "opencv5",
    limit_px: Annotated[Positive, IN_INPUT] = 0.5,
) -> Run:
    """Do everything after the capture: noise, geometry, reconstruction, report; skip what is up to date.

    A result is up to date while its input files (by hash), its options and the versions of the software are those that
    it records. If a step fails, the results of the others are kept. Options of the reconstruction are those of
    `reconstruct`; planes are by default at the depths under [scene] in the rig.toml.

    Parameters
    ----------
    session
        Folder of the session.
    lens
        Distortion model, as for `geometry`.
    limit_px
        Largest accepted standard deviation of the transfer between views, as for `geometry`.
    """
    # Of `reconstruct`, five options have no place here: --out, as results lie in the session; --geometry, which is
    # measured; --scene, as the page is that of the dark scene; --part, as the page needs all planes; and --dry-run, as
    # planes need noise and geometry. The bright scene, and parts, are reconstructed by `reconstruct`
    from faintfield.pipelines.workflows.session import run_session

    return run_session(session, options, lens, limit_px)


def reconstruct(
    set_path: Annotated[Path, Parameter(name="SESSION|SET"), IN_INPUT],
    /,
    *,
    out: Annotated[Path | None, IN_OUTPUT] = None,
    options: Options = DEFAULTS,
    geometry: Annotated[Path | None, IN_INPUT] = None,
    scene: Annotated[SceneKind, IN_INPUT] = "dark_scene",
    part: Annotated[str | None, IN_MACHINE] = None,
    dry_run: Annotated[bool, IN_MACHINE] = False,
) -> Reconstruction:
    """Reconstruct planes of the scene at chosen depths, or one picture that is sharp everywhere, with its depth.

    Each plane becomes a float32 TIFF (expected electrons per detector pixel of the reference view), a preview, and an
    entry in reconstruction.json; report.html shows them all. With several methods, each has its own folder in OUT.
    Planes that were already made of the same files with the same options are kept, so an interrupted sweep resumes.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder for the results; planes of the same depth are replaced. By default, for a session, its folder
        reconstructions.
    geometry
        geometry.json, or its folder; its lens and measured poses replace those of the set, node by node.
    scene
        Set of the session to reconstruct: the dark scene or the bright scene.
    part
        I/N: make only every N-th plane from the I-th on, and no report, as one of N jobs of a cluster that write to the
        same OUT at the same time. When all have ended, the same command without --part puts the sweep together.
    dry_run
        Write nothing, but say how many planes are missing, and about how much time and memory they take on this
        computer. With --part: those of the part.
    """
    from faintfield.pipelines.workflows.reconstruct import forecast_folder, parse_part, reconstruct_folder

    chosen = None if part is None else parse_part(part)
    if dry_run:
        return forecast_folder(set_path, out, options, geometry, scene, chosen)
    return reconstruct_folder(set_path, out, options, geometry, scene, chosen)


def report(directory: Path, /) -> dict[str, str]:
    """Write report.html again from the results in a folder and the folders within it.

    The page begins with the planes next to what the camera saw. Then come sliders; errors; noise and geometry of the
    camera, if noise.json and geometry.json are in the folder or in one of the two above; the set and its light; and how
    everything was made.

    Parameters
    ----------
    directory
        Folder with reconstruction.json or surface.json, or whose folders have one: what `reconstruct` wrote,
        or a session.
    """
    from faintfield.pipelines.pages.report import write_report

    with working("writing the report"):
        return {"report": str(write_report(directory))}


def view(directory: Path, /) -> dict[str, list[str]]:
    """Open the planes of a folder in napari, if it is installed: in the units of the set, on one grey scale.

    A few planes are one layer each; a sweep in equal steps is one layer per method, with a slider over depth.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    from faintfield.pipelines.pages.napari_layers import show_planes

    return {"layers": show_planes(directory)}


def figures(
    out: Path,
    /,
    *,
    only: Annotated[list[FigureNumber] | None, Parameter(consume_multiple=True)] = None,
    snr: Positive = 0.16,
    seed: Seed = 1,
    seeds: Count = 5,
    size_px: SizePx = (640, 480),
) -> Figures:
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
    from faintfield.pipelines.paper.figures import FigureOptions, make_figures

    options = FigureOptions(only=sorted(set(only or (2, 3, 4))), snr=snr, seed=seed, seeds=seeds, size_px=size_px)
    return make_figures(out, options)
