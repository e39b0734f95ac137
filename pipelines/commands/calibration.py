"""Commands that measure a sensor, and where the camera was."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, overload

from cyclopts import Parameter

from faintfield.pipelines.arguments import LensName, Positive, SceneKind
from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.calibration.noise_comparison import NoiseComparison
    from faintfield.pipelines.formats.results.noise import NoiseRecord
    from faintfield.pipelines.workflows.align import AlignmentSummary
    from faintfield.pipelines.workflows.geometry import GeometrySummary

type Noise = NoiseRecord | NoiseComparison
type Geometry = GeometrySummary
type Alignment = AlignmentSummary


@overload
def noise(folder: Path, /, *, out: Path | None = None) -> "NoiseRecord": ...
@overload
def noise(*, compare: tuple[Path, Path]) -> "NoiseComparison": ...
def noise(folder: Path | None = None, /, *, out: Path | None = None, compare: tuple[Path, Path] | None = None) -> Noise:
    """Measure offset, gain, read noise and dark current from dark frames, and flats if there are any.

    Writes noise.json (numbers with 95 % intervals, or why there are none), noise_maps.npz (per pixel), and noise.html,
    a page with the numbers, plots of the fit, maps, and the report by EMVA 1288. With --compare instead of FOLDER:
    tells whether a camera has changed from one measurement to another, and writes nothing.

    Parameters
    ----------
    folder
        A session with dark frames, or a folder with noise.toml and the frames that it names.
    out
        Where to write; FOLDER itself if not given.
    compare
        Two results of this command, noise.json or their folders: the earlier and the later one.
    """
    from faintfield.pipelines.workflows.noise import compare_sensors, measure_sensor

    if compare is not None:
        if folder is not None or out is not None:
            raise WrongUsage("--compare takes two results and writes nothing; leave out FOLDER and --out")
        return compare_sensors(*compare)
    if folder is None:
        raise WrongUsage("nothing to measure is named; give a FOLDER with frames, or two results with --compare A B")
    return measure_sensor(folder, out)


def geometry(
    directory: Path,
    /,
    *,
    out: Path | None = None,
    lens: LensName = "opencv5",
    depth_mm: list[Positive] | None = None,
    limit_px: Positive = 0.5,
) -> Geometry:
    """Measure the lens, and where the camera was at every node, from images of ChArUco boards.

    Writes geometry.json, its covariance, a .cameramodel per node, and a page about the stage. A set that cannot tell
    the geometry is refused, with the reason and what to add.

    Parameters
    ----------
    directory
        A session with charuco frames, or a folder with charuco.toml and the images it names.
    out
        Folder for the results; DIRECTORY by default.
    lens
        Distortion model.
    depth_mm
        Depth of a plane that will be reconstructed; give it once per plane. 500 and 700 by default.
    limit_px
        How well the transfer between views by such a plane must be known: standard deviation, rms over views.
    """
    from faintfield.pipelines.workflows.geometry import measure_stage

    return measure_stage(directory, out, lens, depth_mm, limit_px)


def align(
    set_path: Path,
    /,
    *,
    out: Path | None = None,
    depth: Annotated[list[float] | None, Parameter(allow_leading_hyphen=True)] = None,
    depth_range: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
    position_error: Positive | None = None,
    rotation_error_mrad: Positive | None = None,
    with_lens: bool = False,
) -> Alignment:
    """Find where the camera was at every node from the views of the scene themselves, dark ones, too.

    Writes geometry.json with source "views", its covariance, and a page that shows the scene before and after. All
    commands take the poses of SET-PATH from there; with --out, `reconstruct --geometry` takes them. The new poses are
    accepted only if they predict pixels that were held out better than the old ones do, beyond chance. Otherwise the
    command says so, and removes the poses of an earlier call; its exit status is 0 in both cases, and --json tells.

    Parameters
    ----------
    set_path
        A folder with elemental.toml, or a session whose noise and geometry were measured: its poses are then the start,
        and what changed since is measured.
    out
        Folder for the results; by default the folder alignment in SET-PATH.
    depth
        Depth of a plane of the scene in the unit of the set; give it once per plane. By default the depth of each pixel
        is found, which suits all scenes; planes are more precise where the scene is nothing else.
    depth_range
        NEAR:FAR in the unit of the set: range in which depths are sought, such as 400:1500. By default it is found.
    geometry
        geometry.json, or its folder, whose poses are the start instead of those of the set.
    scene
        Set of the session whose views are aligned.
    position_error
        Standard deviation of a node's position along each axis, in the unit of the poses, where the estimate from the
        views starts; by default 0.6 % of the distance between nodes, or 0.02 % if the poses were measured.
    rotation_error_mrad
        The same of a node's rotation about each axis; by default 3.5, or 0.03 if the poses were measured.
    with_lens
        Find the first term of distortion, too, and with --depth the focal length: at unknown depths, a longer one and
        depths further away look alike.
    """
    from faintfield.pipelines.workflows.align import align_views

    return align_views(
        set_path,
        out,
        depth=depth or (),
        depth_range=depth_range,
        geometry=geometry,
        scene=scene,
        position_error=position_error,
        rotation_error_mrad=rotation_error_mrad,
        with_lens=with_lens,
    )
