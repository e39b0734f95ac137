"""Camera poses by the views of a set or session, with their record, files and page: `faintfield align`."""

import io
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import SceneKind
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile, OutputExists, WrongUsage
from faintfield.pipelines.formats.files import check_results_folder, exclusive, remove
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.results.alignment import (
    ALIGNMENT_PAGE,
    AlignmentOptions,
    AlignmentRecord,
    HeldOutGain,
    LensChange,
    PoseErrors,
    ViewChange,
)
from faintfield.pipelines.formats.results.geometry import (
    ALIGNMENT_FOLDER,
    COVARIANCE_FILE,
    GEOMETRY_FILE,
    CameraPoses,
    LensRecord,
    NodeRecord,
    PosesOfSession,
    read_geometry,
    write_geometry,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, check_exists
from faintfield.pipelines.pages.alignment_page import alignment_page
from faintfield.pipelines.reconstruction.alignment import (
    Aligned,
    PoseUncertainty,
    align_set,
    assumed_errors,
    change_lens,
    inverse_depth_sigma,
    plausible_errors,
    pose_uncertainty,
    shifts_px,
    transfer_sigmas_px,
)
from faintfield.pipelines.reconstruction.request import distinct_depths
from faintfield.pipelines.reconstruction.surface.request import range_in_mm
from faintfield.pipelines.workflows.reconstruct import open_set
from faintfield.recon.alignment.cameras import LENS, move_poses
from faintfield.recon.alignment.estimate import Alignment
from faintfield.recon.errors import NothingInFocus

# Errors that are found may be so many times the plausible ones; beyond, what was aligned is hardly the scene.
_MOST_EXCESS = 6.0


class AlignmentSummary(msgspec.Struct, frozen=True):
    """The result of `faintfield align`: whether the views gave better poses, and the main figures of geometry.json."""

    accepted: bool
    reason: str
    out: str | UnsetType = UNSET
    report: str | UnsetType = UNSET
    gain: HeldOutGain | UnsetType = UNSET
    errors_found: PoseErrors | UnsetType = UNSET
    transfer_sigma_px: dict[str, float] | UnsetType = UNSET


def align_views(
    folder: Path,
    out: Path | None = None,
    *,
    depth: Sequence[float] = (),
    depth_range: str | None = None,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
    position_error: float | None = None,
    rotation_error_mrad: float | None = None,
    with_lens: bool = False,
) -> AlignmentSummary:
    """Find the poses of a set or session by its views, and write them with their page if they are better.

    Raises
    ------
    InputError, ReconstructionError
        The set cannot be used, or its depths do not suit it.
    """
    if depth and depth_range is not None:
        raise WrongUsage("--depth names planes and --depth-range searches for depths; leave out one of the two")
    check_exists(folder)
    out = out or (folder if is_folder(folder) else folder.parent) / ALIGNMENT_FOLDER
    check_results_folder(out)
    _check_not_of_boards(out)
    elemental_set, _ = open_set(folder, out, scene, geometry, aligned=False)
    if elemental_set.measured_in is not None and out.resolve() == elemental_set.measured_in.parent.resolve():
        raise OutputExists(f"{out}: holds the geometry.json that the alignment starts from; name another --out")
    if geometry is not None:
        _check_not_by_these_views(geometry, elemental_set)
    depths_mm = distinct_depths([elemental_set.depth_in_mm(value) for value in depth], elemental_set)
    range_mm = None if depth_range is None else range_in_mm(elemental_set, "--depth-range", depth_range)
    errors = assumed_errors(elemental_set, position_error, rotation_error_mrad)
    options = AlignmentOptions(
        tuple(depths_mm), range_mm, errors.sigma_mm, 1e3 * errors.sigma_rad, elemental_set.poses, with_lens
    )
    try:
        aligned = align_set(elemental_set, depths_mm, range_mm, errors, with_lens=with_lens)
    except NothingInFocus as failure:
        return _unchanged(out, f"the views tell no poses: {failure}")
    gain = HeldOutGain(**vars(aligned.alignment.gain))
    if why := _refusal(aligned.alignment, gain, plausible_errors(elemental_set, errors), options):
        return msgspec.structs.replace(_unchanged(out, why), gain=gain)
    record, uncertainty = _record(elemental_set, aligned, options)
    page = alignment_page(record, aligned.alignment.pictures, elemental_set.units.tone_curve)
    write_geometry(out, record, {COVARIANCE_FILE: _covariance_file(record, uncertainty), ALIGNMENT_PAGE: page})
    _inform_of(record)
    figures = {name: getattr(record, name) for name in ("gain", "errors_found", "transfer_sigma_px")}
    reason = f"the new poses predict held-out pixels better, by {gain.text}"
    return AlignmentSummary(True, reason, str(out), str(out / ALIGNMENT_PAGE), **figures)


def _check_not_of_boards(out: Path) -> None:
    """Refuse a folder with poses of another command (OutputExists); a damaged file is replaced."""
    with suppress(BadValue, MissingFile):
        if read_geometry(out, CameraPoses).source is UNSET:
            raise OutputExists(f"{out}: holds a {GEOMETRY_FILE} that was not found by the views; name another --out")


def _refusal(alignment: Alignment, gain: HeldOutGain, plausible: PoseErrors, options: AlignmentOptions) -> str | None:
    """Return why the new poses are not accepted, None if they are."""
    prior = alignment.prior
    excess = max(prior.sigma_rad / plausible.sigma_rad, prior.sigma_mm / plausible.sigma_mm)
    if excess > _MOST_EXCESS:
        return (
            f"the poses stay as they are: they would be wrong by {1e3 * prior.sigma_rad:.3g} mrad and "
            f"{prior.sigma_mm:.3g} in the unit of the poses, {excess:.0f} times what is plausible; the depths may be "
            "wrong, or the pictures show what does not move with the scene, such as a vignette or stray light; if "
            "errors are that large, state them by `faintfield align --rotation-error-mrad … --position-error …`"
        )
    if alignment.gain.sure:
        return None
    remedy = ", and `faintfield align --depth …` helps where planes at known depths hold all of the scene"
    advice = "" if options.depth_mm else remedy
    return (
        "the poses stay as they are: the new ones do not predict held-out pixels better, beyond chance (gain of "
        f"{gain.text}; more than 3 are needed); they may be right, or light or views too few{advice}"
    )


def _check_not_by_these_views(geometry: Path, elemental_set: ElementalSet) -> None:
    """Refuse poses that were found by the same views (BadValue): noise would count twice."""
    found = read_geometry(geometry, PosesOfSession)
    images = {view.image for view in elemental_set.settings.view}
    hashes = {digest for name, digest in elemental_set.input_hashes().items() if name in images}
    if found.source == "views" and hashes & set(found.inputs.values()):
        raise BadValue(f"{geometry}: was found by these views already; leave out --geometry, or give that of boards")


def _unchanged(out: Path, reason: str) -> AlignmentSummary:
    """Say that there are no new poses, and remove those of an earlier call."""
    with exclusive(out):
        if is_file(out / GEOMETRY_FILE):
            reason = f"{reason}; those of an earlier alignment are removed"
        for name in (GEOMETRY_FILE, COVARIANCE_FILE, ALIGNMENT_PAGE):
            remove(out / name)
    inform(reason)
    return AlignmentSummary(False, reason)


def _record(
    elemental_set: ElementalSet, aligned: Aligned, options: AlignmentOptions
) -> tuple[AlignmentRecord, PoseUncertainty]:
    alignment, reference = aligned.alignment, elemental_set.reference_view
    old, lens = elemental_set.lens, change_lens(elemental_set.lens, alignment.lens_change)
    uncertainty = pose_uncertainty(alignment, reference, lens)
    middle_mm = float(2 / (1 / aligned.depths_mm[0] + 1 / aligned.depths_mm[-1]))
    before, after = elemental_set.poses_rt_cam_ref, alignment.rt_cam_ref
    shifts = shifts_px((old, before), (lens, after), middle_mm)
    left = shifts_px((lens, move_poses(after, -alignment.last_steps)), (lens, after), middle_mm)
    nodes, of_lens = elemental_set.nodes, len(lens.parameters)
    of_poses = uncertainty.covariance[of_lens:, of_lens:]
    turns = alignment.steps[:, 2]
    record = AlignmentRecord(
        source="views",
        lens=LensRecord("opencv", lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, tuple(lens.distortion)),
        lens_change=_lens_change(old, lens, alignment) if options.with_lens else UNSET,
        size_px=lens.size_px,
        reference_node=nodes[reference],
        nodes=[
            NodeRecord(node, tuple(pose), sigma_mm, sigma_rad)
            for node, pose, sigma_mm, sigma_rad in zip(
                nodes, after.tolist(), uncertainty.sigma_mm.tolist(), uncertainty.sigma_rad.tolist(), strict=True
            )
        ],
        views=[
            ViewChange(node, _mean_shift(shift), float(turn), float(np.sqrt(np.nanmean(np.sum(rest**2, axis=1)))))
            for node, shift, turn, rest in zip(nodes, shifts, turns, left, strict=True)
        ],
        gain=HeldOutGain(**vars(alignment.gain)),
        errors_assumed=PoseErrors(1e-3 * options.rotation_error_mrad, options.position_error_mm),
        errors_found=PoseErrors(alignment.prior.sigma_rad, alignment.prior.sigma_mm),
        dispersion=alignment.dispersion,
        rounds=len(alignment.rounds),
        bins_px=aligned.bins_px,
        transfer_sigma_px={
            elemental_set.depth_text(float(f"{depth:.3g}")): transfer_sigmas_px(
                lens, after, reference, uncertainty, depth
            )
            for depth in (aligned.depths_mm[0], aligned.depths_mm[-1])
        },
        inverse_depth_sigma=inverse_depth_sigma(
            before, after, of_poses, middle_mm, depths_known=bool(options.depth_mm)
        ),
        **provenance("align", options, elemental_set.input_hashes(), elemental_set.units).parts(),
    )
    return record, uncertainty


def _lens_change(old: Lens, new: Lens, alignment: Alignment) -> LensChange:
    sigma, sigma_added = np.sqrt(np.diag(alignment.covariance))[-LENS:].tolist()
    added = new.distortion[0] - (*old.distortion, 0.0)[0]
    return LensChange(alignment.lens_change[0], sigma, added, sigma_added)


def _mean_shift(shift: NDArray[np.float64]) -> tuple[float, float]:
    right, down = np.nanmean(shift, axis=0).tolist()
    return right, down


def _covariance_file(record: AlignmentRecord, uncertainty: PoseUncertainty) -> bytes:
    content, nodes = io.BytesIO(), np.array([entry.node for entry in record.nodes])
    lens = record.camera_lens().parameters
    np.savez_compressed(content, covariance=uncertainty.covariance, nodes=nodes, intrinsics=lens)
    return content.getvalue()


def _inform_of(record: AlignmentRecord) -> None:
    if not record.options.depth_mm:
        inform(f"depths between {' and '.join(record.transfer_sigma_px)}")
    shifts = np.array([view.shift_px for view in record.views])
    turns = np.degrees([view.turn_rad for view in record.views])
    inform(
        f"views move by {np.sqrt(np.mean(np.sum(shifts**2, axis=1))):.2f} px rms, at most "
        f"{np.linalg.norm(shifts, axis=1).max():.2f} px, and turn by up to {np.abs(turns).max():.2f}°"
    )
    if change := record.lens_change or None:
        inform(
            f"focal length {record.lens.fx_px:.6g} px, by {100 * change.focal_length:+.3f} ± "
            f"{100 * change.focal_length_sigma:.3f} %; first distortion term {record.lens.distortion[0]:.4f}, by "
            f"{change.distortion:+.4f} ± {change.distortion_sigma:.4f}"
        )
    known = ", ".join(f"{sigma:.2f} px at {depth}" for depth, sigma in record.transfer_sigma_px.items())
    inform(f"transfer between views known to {known}")
    inform(f"held-out pixels are predicted better, by {record.gain.text}")
