"""Poses by the views against true ones: `python -m benchmarks.calibration.alignment`.

Simulated sets whose stated poses are wrong are aligned by `faintfield align`, and their planes reconstructed with the
stated, the new and the true poses. Printed are the mean square errors of the planes against the objects (of surfaces,
that of the picture on the true surface), the errors of the transfer where there is detail after the common motion of
all views is removed, and the NEES of the poses: their squared errors over the covariance, 1 if that holds.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, transfer
from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.geometry import COVARIANCE_FILE
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.ground_truth import Truth, texture_and_region
from faintfield.pipelines.formats.sets.session_set import with_measured_geometry
from faintfield.pipelines.reconstruction.channels import load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.planes.penalised import Objective, solve_pmlem
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.pipelines.simulation.synthetic_set import write_synthetic_set
from faintfield.pipelines.workflows.align import align_views
from faintfield.recon.alignment.cameras import steps_between
from faintfield.recon.metrics import mean_square_error
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.solver.data_fit import SceneProblem

_DEPTHS_MM = (500.0, 700.0)

# Points with detail at which transfers are compared.
_POINTS = 400


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.alignment", description=__doc__)
    parser.add_argument("--snr", type=float, nargs="+", default=[0.16, 1.0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--objects", nargs="+", default=["toys", "planes", "surfaces"])
    parser.add_argument("--position-error-mm", type=float, default=0.3)
    parser.add_argument("--rotation-error-mrad", type=float, default=3.5)
    parser.add_argument("--size-px", type=int, nargs=2, default=(640, 480))
    asked = parser.parse_args()
    print("| scene | SNR | seed | CPU s | gain | NEES | transfer px: stated, aligned | MSE: stated, aligned, true |")
    print("|---|---|---|---|---|---|---|---|")
    for objects in asked.objects:
        for snr in asked.snr:
            for seed in asked.seeds:
                options = SyntheticOptions(
                    snr=snr,
                    seed=seed,
                    poses="nominal",
                    objects="surfaces" if objects == "surfaces" else "toys",
                    size_px=(asked.size_px[0], asked.size_px[1]),
                    position_error_mm=asked.position_error_mm,
                    rotation_error_mrad=asked.rotation_error_mrad,
                )
                print(_row(objects, options), flush=True)


def _row(objects: str, options: SyntheticOptions) -> str:
    with TemporaryDirectory(prefix="faintfield-") as name:
        folder, out = Path(name) / "set", Path(name) / "alignment"
        truth = write_synthetic_set(folder, options)
        stated, true_poses = load_set(folder), np.array(truth.true_rt_cam_ref)
        started = time.process_time()
        summary = align_views(folder, out, depth=_DEPTHS_MM if objects == "planes" else ())
        used_s = time.process_time() - started
        aligned = with_measured_geometry(stated, out) if summary.accepted else stated
        sets = (stated, aligned, with_poses(stated, true_poses))
        errors = ", ".join("/".join(f"{error:.4f}" for error in _errors(posed, truth)) for posed in sets)
        places = places_of_detail(stated, truth)
        transfers = ", ".join(f"{transfer_px(posed, true_poses, places):.2f}" for posed in sets[:2])
        nees = f"{_nees(aligned, true_poses, out):.2f}" if summary.accepted else "–"
        gain = f"{summary.gain.value / summary.gain.sigma:.1f} σ" if summary.gain else "–"
        scene = f"| {objects} | {options.snr:g} | {options.seed} "
        return f"{scene}| {used_s:.0f} | {gain} | {nees} | {transfers} | {errors} |"


def with_poses(elemental_set: ElementalSet, poses: NDArray[np.float64]) -> ElementalSet:
    """Return a set whose views state other poses (view, 6)."""
    views = [
        msgspec.structs.replace(view, rt_cam_ref=tuple(pose))
        for view, pose in zip(elemental_set.settings.view, poses.tolist(), strict=True)
    ]
    return replace(elemental_set, settings=msgspec.structs.replace(elemental_set.settings, view=views))


def _errors(posed: ElementalSet, truth: Truth) -> list[float]:
    """Return the errors of planes by total variation against the objects, or that of a picture on the true surface."""
    (layout,) = posed.layouts
    images = load_channel(posed, layout)
    factory = OperatorFactory(posed, layout, images)

    def solved(operator: PlaneOperator | SurfaceOperator) -> NDArray[np.floating]:
        (solution,) = solve_pmlem(Objective.of(SceneProblem(operator, images), SolverOptions()))
        return solution.plane

    if truth.surface is None:
        errors = []
        for plane in truth.planes:
            texture, region = texture_and_region(posed.folder, plane)
            found = solved(factory.at(plane.depth_mm, plane_grid(posed, plane.depth_mm)))
            errors.append(mean_square_error(found, texture, region))
        return errors
    depth_mm, picture = (
        read_frame(posed.folder / name).pixels_dn for name in (truth.surface.depth_mm, truth.surface.picture)
    )
    found = solved(factory.of_surface(1 / depth_mm, plane_grid(posed, 1.0)))
    return [mean_square_error(found, picture, np.isfinite(depth_mm))]


def places_of_detail(elemental_set: ElementalSet, truth: Truth) -> dict[float, NDArray[np.float64]]:
    """Return pixels (point, 2) of the reference view where there is detail, by depth."""
    generator, places = np.random.default_rng(0), {}
    if truth.surface is not None:
        picture = np.asarray(read_frame(elemental_set.folder / truth.surface.picture).pixels_dn, float)
        return {depth_mm: _drawn(picture, generator) for depth_mm in _DEPTHS_MM}
    for plane in truth.planes:
        texture, region = texture_and_region(elemental_set.folder, plane)
        places[plane.depth_mm] = _drawn(np.where(region, texture, 0), generator)
    return places


def _drawn(picture: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Return pixels (point, 2), column and row, drawn as often as the square of the gradient says."""
    energy = np.sum(np.square(np.gradient(picture)), axis=0).ravel()
    chosen = generator.choice(energy.size, _POINTS, p=energy / energy.sum())
    rows, columns = np.unravel_index(chosen, picture.shape)
    return np.column_stack([columns, rows]).astype(float)


def transfer_px(
    posed: ElementalSet,
    true_poses: NDArray[np.float64],
    places: dict[float, NDArray[np.float64]],
    *,
    without_drift: bool = False,
) -> float:
    """Return the rms error of the transfer to the views, less what all views have in common.

    Without drift: less what is linear in row and column of the nodes, too, as by another depth.
    """
    squares, ones = [], np.ones((len(true_poses), 1))
    shared = np.hstack([ones, np.array(posed.nodes, float)]) if without_drift else ones
    projection = np.eye(len(ones)) - shared @ np.linalg.pinv(shared)
    for depth_mm, pixels in places.items():
        plane = fronto_parallel_rt_ref_plane(depth_mm)
        moved = [
            transfer(posed.lens, found, plane, pixels) - transfer(posed.lens, true, plane, pixels)
            for found, true in zip(posed.poses_rt_cam_ref, true_poses, strict=True)
        ]
        squares.append(np.sum(np.tensordot(projection, np.array(moved), 1) ** 2, axis=2))
    return float(np.sqrt(np.mean(squares)))


def _nees(aligned: ElementalSet, true_poses: NDArray[np.float64], out: Path) -> float:
    """Return the squared errors of all poses but the reference's over their covariance, per number."""
    with np.load(out / COVARIANCE_FILE) as arrays:
        covariance, lens = arrays["covariance"], len(arrays["intrinsics"])
    others = np.delete(np.arange(len(true_poses)), aligned.reference_view)
    rows = (lens + 6 * others[:, np.newaxis] + np.arange(6)).ravel()
    error = steps_between(true_poses, aligned.poses_rt_cam_ref)[others].ravel()
    return float(error @ np.linalg.solve(covariance[np.ix_(rows, rows)], error)) / len(error)


if __name__ == "__main__":
    main()
