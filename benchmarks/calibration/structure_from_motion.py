"""Poses by the views against COLMAP's: `python -m benchmarks.calibration.structure_from_motion`.

Simulated sets whose stated poses are wrong are aligned by `faintfield align` and by COLMAP, and the errors of the
transfer between views compared as in `benchmarks.calibration.alignment`; the second of two numbers is without what is
linear in row and column. COLMAP is given the true lens, pictures of even noise, and all pairs of views. It starts once
from the stated poses (points triangulated, then all adjusted together, by turns), and once from nothing (incremental
mapping). Its model is turned and scaled to the stated poses.

With `--copy SET OUT`, a copy of a set with COLMAP's poses is written instead.

COLMAP serves development only. Make an environment for it (`python -m venv build/colmap`, `build/colmap/bin/pip install
--no-deps pycolmap`), and add its site-packages to the end of PYTHONPATH.
"""

import argparse
import shutil
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

try:
    import pycolmap  # type: ignore[import-not-found]
except ModuleNotFoundError:
    pycolmap = None

from benchmarks.calibration.alignment import places_of_detail, transfer_px, with_poses
from faintfield.pipelines.formats.sets.elemental_file import write_set
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.session_set import with_measured_geometry
from faintfield.pipelines.reconstruction.depth.search import luminance
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.pipelines.simulation.synthetic_set import write_synthetic_set
from faintfield.pipelines.workflows.align import align_views
from faintfield.recon.surface.pinhole_views import UNKNOWN

# Most features of a view, and fewest points that it must share with others to be registered.
_FEATURES, _MIN_POINTS = 8192, 15

# Largest error of a point's projection at each turn from the stated poses, and scale of Cauchy's loss.
_TURNS_PX, _LOSS_PX = (12.0, 4.0, 3.0), 0.5

# Least angle between the rays to a point.
_LEAST_DEG = 0.3

_SEED = 1


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.structure_from_motion", description=__doc__)
    parser.add_argument("--snr", type=float, nargs="+", default=[0.16, 1.0, 5.0, 20.0, 100.0, 1000.0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--objects", nargs="+", default=["toys", "surfaces"])
    parser.add_argument("--copy", type=Path, nargs=2, metavar=("SET", "OUT"))
    asked = parser.parse_args()
    if pycolmap is None:
        parser.error("pycolmap is missing; install it into an environment of its own, see --help")
    if asked.copy:
        _write_copy(*asked.copy)
        return
    print("| scene | SNR | seed | stated px | align: px, s | COLMAP, from stated poses: px, views, s | from nothing |")
    print("|---|---|---|---|---|---|---|")
    for objects in asked.objects:
        for snr in asked.snr:
            for seed in asked.seeds:
                print(_row(SyntheticOptions(snr=snr, seed=seed, poses="nominal", objects=objects)), flush=True)


def _row(options: SyntheticOptions) -> str:
    with TemporaryDirectory(prefix="faintfield-") as name:
        folder, out = Path(name) / "set", Path(name) / "alignment"
        truth = write_synthetic_set(folder, options)
        stated, true_poses = load_set(folder), np.array(truth.true_rt_cam_ref)
        places = places_of_detail(stated, truth)
        started = time.process_time()
        summary = align_views(folder, out)
        used_s = time.process_time() - started
        aligned = with_measured_geometry(stated, out) if summary.accepted else stated

        def errors(posed: ElementalSet) -> str:
            each = (transfer_px(posed, true_poses, places, without_drift=drift) for drift in (False, True))
            return "/".join(f"{error_px:.2f}" for error_px in each)

        cells = [errors(stated), f"{errors(aligned)}, {used_s:.0f}"]
        started = time.process_time()
        _match_features(stated, Path(name))
        matched_s = time.process_time() - started
        for solve in (_from_stated_poses, _from_nothing):
            started = time.process_time()
            poses, registered = _in_set(solve(stated, Path(name)), stated)
            used_s = matched_s + time.process_time() - started
            error = errors(with_poses(stated, poses)) if registered else "–"
            cells.append(f"{error}, {registered}, {used_s:.0f}")
    return f"| {options.objects} | {options.snr:g} | {options.seed} | {' | '.join(cells)} |"


def _write_copy(folder: Path, out: Path) -> None:
    elemental_set = load_set(folder)
    with TemporaryDirectory(prefix="faintfield-") as name:
        _match_features(elemental_set, Path(name))
        poses, registered = _in_set(_from_stated_poses(elemental_set, Path(name)), elemental_set)
    shutil.copytree(folder, out, ignore=shutil.ignore_patterns("alignment"))
    write_set(out, with_poses(elemental_set, poses).settings)
    print(f"{out}: {registered} of {len(poses)} views with COLMAP's poses; {time.process_time():.0f} s of CPU time")


def _match_features(elemental_set: ElementalSet, folder: Path) -> None:
    """Write the views as pictures of 8 bits, and a database of their features and of matches between all pairs."""
    views = luminance(elemental_set, int(np.lcm(*elemental_set.layouts[0].lattices[0].step)))
    light_e = np.where(views.light_e > UNKNOWN / 2, views.light_e, 0)
    even = 2 * np.sqrt(np.maximum(light_e + views.variance_e2 + 3 / 8, 0))  # Anscombe: σ of about 1
    low, high = np.percentile(even[:, ::4, ::4], [0.1, 99.9])
    scale = 255 / (high - low)
    (folder / "pictures").mkdir()
    for number, picture in enumerate(even):
        stretched = np.clip((picture - low) * scale, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / "pictures" / f"{number:04}.png"), stretched)
    pycolmap.extract_features(
        folder / "features.db",
        folder / "pictures",
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params="1,1,0,0"),
        extraction_options=pycolmap.FeatureExtractionOptions(sift={"max_num_features": _FEATURES}),
    )
    settings = elemental_set.settings.camera
    with pycolmap.Database.open(folder / "features.db") as database:
        for image in database.read_all_images():
            camera = database.read_camera(image.camera_id)
            centre = elemental_set.principal_points_px[int(Path(image.name).stem)] + 0.5  # of the first pixel
            camera.params = np.array([settings.fx_px, settings.fy_px, *centre])
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    ransac = {"random_seed": _SEED}
    pycolmap.match_exhaustive(
        folder / "features.db", verification_options=pycolmap.TwoViewGeometryOptions(ransac=ransac)
    )


def _options(error_px: float) -> Any:
    """Return COLMAP's options with the lens fixed, for small angles between rays."""
    options = pycolmap.IncrementalPipelineOptions(multiple_models=False, extract_colors=False, random_seed=_SEED)
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.abs_pose_min_num_inliers = options.mapper.init_min_num_inliers = _MIN_POINTS
    options.mapper.init_min_tri_angle, options.mapper.filter_max_reproj_error = 2.0, error_px
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = _LEAST_DEG
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = error_px
    options.triangulation.ignore_two_view_tracks, options.triangulation.random_seed = False, _SEED
    return options


def _from_nothing(elemental_set: ElementalSet, folder: Path) -> Any:
    models = pycolmap.incremental_mapping(
        folder / "features.db", folder / "pictures", folder, options=_options(_TURNS_PX[-1])
    )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=pycolmap.Reconstruction())


def _from_stated_poses(elemental_set: ElementalSet, folder: Path) -> Any:
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(folder / "features.db") as database:
        for image in database.read_all_images():
            model.add_camera_with_trivial_rig(database.read_camera(image.camera_id))
            pose = elemental_set.poses_rt_cam_ref[int(Path(image.name).stem)]
            turn = pycolmap.Rotation3d(Rotation.from_rotvec(pose[:3]).as_quat())
            image = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, pose[3:]))
    adjustment = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_extra_params=False, print_summary=False
    )
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = _LOSS_PX
    for error_px in _TURNS_PX:
        model = pycolmap.triangulate_points(
            model, folder / "features.db", folder / "pictures", folder, options=_options(error_px)
        )
        if model.num_points3D() >= _MIN_POINTS:
            pycolmap.bundle_adjustment(model, adjustment)
    return model


def _in_set(model: Any, elemental_set: ElementalSet) -> tuple[NDArray[np.float64], int]:
    """Return COLMAP's poses turned and scaled to those stated, which views keep that it did not register; their number.

    The reference view stays where it is, as in an alignment.
    """
    stated, reference = elemental_set.poses_rt_cam_ref, elemental_set.reference_view
    images = {int(Path(image.name).stem): image for image in model.images.values()}
    views = [n for n, image in sorted(images.items()) if image.has_pose and image.num_points3D >= _MIN_POINTS]
    if reference not in views or len(views) < 2:
        return stated, 0
    matrices = np.array([images[view].cam_from_world().matrix() for view in views])
    turns, at = Rotation.from_matrix(matrices[:, :, :3]), views.index(reference)
    stated_turns = Rotation.from_rotvec(stated[views, :3])
    centres, stated_centres = -turns.inv().apply(matrices[:, :, 3]), -stated_turns.inv().apply(stated[views, 3:])
    set_from_model = stated_turns[at].inv() * turns[at]
    apart, stated_apart = set_from_model.apply(centres - centres[at]), stated_centres - stated_centres[at]
    centres = stated_centres[at] + apart * np.sum(apart * stated_apart) / np.sum(apart**2)
    turns, poses = turns * set_from_model.inv(), stated.copy()
    poses[views] = np.column_stack([turns.as_rotvec(), -turns.apply(centres)])
    return poses, len(views)


if __name__ == "__main__":
    main()
