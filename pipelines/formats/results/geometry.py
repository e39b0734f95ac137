"""The record of where the camera was, `geometry.json`, and the files beside it: one type for writer, readers and tests.

Keys stand in the file in the order of the fields. Lengths are in mm, angles in rad, poses Rodrigues vectors and mm.
"""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray

from faintfield.calib.estimate import Repeatability, StageReport
from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import (
    UNFINISHED,
    exclusive,
    remove,
    remove_leftovers,
    sha256,
    translated_write_errors,
    write_record,
    write_whole,
)
from faintfield.pipelines.formats.reading import is_file, is_folder, read_json
from faintfield.pipelines.formats.units import Node, Pose, Shift

if TYPE_CHECKING:  # readers of the record need no solver
    from faintfield.calib.geometry.rig_geometry import HomingShift, RigGeometry
    from faintfield.pipelines.formats.results.alignment import AlignmentRecord

GEOMETRY_FILE = "geometry.json"
COVARIANCE_FILE = "geometry_covariance.npz"
CORNERS_FILE = "geometry_corners.npz"
MODEL_FILE = "geometry.cameramodel"
GEOMETRY_PAGE = "geometry.html"

# Folder in a set or session with the geometry.json that its views were aligned by.
ALIGNMENT_FOLDER = "alignment"
CAMERA_FILE = "cameras/node_r{}_c{}.cameramodel"

# Depths at which a geometry is judged unless others are stated; the paper's.
DEFAULT_DEPTHS_MM = (500.0, 700.0)


class LensRecord(Struct, frozen=True):
    """Lens of the camera.

    Attributes
    ----------
    model : str
        Lens model: "pinhole", "opencv4", "opencv5" or "opencv8"; "opencv" in the record of `faintfield align`.
    fx_px, fy_px : float
        Focal length along x and y.
    cx_px, cy_px : float
        Principal point along x and y, where the centre of the first pixel is (0, 0).
    distortion : tuple of float
        Distortion coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, as many as the model has.
    sigma : tuple of float
        Standard deviations of fx, fy, cx, cy and the distortion coefficients; empty if they are not stated.
    """

    model: str
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]
    sigma: tuple[float, ...] = ()


class NodeRecord(Struct, frozen=True):
    """Pose of the camera at a node; its standard deviations are relative to the reference node.

    Attributes
    ----------
    node : (int, int)
        Row and column of the node.
    rt_cam_ref : tuple of float
        Rodrigues vector in rad and translation in mm, from the reference camera's frame to the camera's.
    sigma_mm : float
        Standard deviation of the camera's centre, over its three axes together.
    sigma_rad : float
        Standard deviation of the camera's orientation, over its three axes together.
    """

    node: Node
    rt_cam_ref: Pose
    sigma_mm: float
    sigma_rad: float

    def centre_mm(self) -> tuple[float, float, float]:
        """Return the camera's centre in the reference frame, `−Rᵀ t`."""
        rt = np.array(self.rt_cam_ref)
        x, y, z = (-cv2.Rodrigues(rt[:3])[0].T @ rt[3:]).tolist()
        return x, y, z


class HomingRecord(Struct, frozen=True):
    """Shift of all cameras from one homing of the stage to a later one, in the reference frame, with its error.

    Attributes
    ----------
    before, after : int
        Number of the earlier homing; number of the later homing.
    shift_mm, sigma_mm : tuple of float
        Shift along x, y and z; standard deviation along each axis.
    """

    before: int
    after: int
    shift_mm: Shift
    sigma_mm: tuple[float, float, float]


class CameraPoses(Struct, frozen=True, kw_only=True):
    """The part of `geometry.json` that a reconstruction needs; a file written by hand may hold nothing else.

    Attributes
    ----------
    format : 1
        Version of the format.
    source : {"views"}, optional
        "views": the poses were found by the views of the scene and include the shifts by homings. Absent: by boards.
    lens : LensRecord
        Lens of the camera.
    size_px : (int, int)
        Width and height of the images.
    reference_node : (int, int)
        Row and column of the node whose camera is the reference frame.
    nodes : list of NodeRecord
        Pose of the camera at each node.
    homings : list of HomingRecord, optional
        Shifts by homings of the stage between the board images, where they show.
    inverse_depth_sigma : float, optional
        Standard deviation that the 1/depth of all points has in common, as the views do not tell it from rotations that
        grow along the grid; in the inverse of the unit of lengths. Absent: by boards, or from an older version.
    """

    format: Literal[1] = 1
    source: Literal["views"] | UnsetType = UNSET
    lens: LensRecord
    size_px: tuple[int, int]
    reference_node: Node
    nodes: Annotated[list[NodeRecord], Meta(min_length=1)]
    homings: list[HomingRecord] | UnsetType = UNSET
    inverse_depth_sigma: Annotated[float, Meta(ge=0)] | UnsetType = UNSET

    def camera_lens(self) -> Lens:
        """Return the lens; ValueError if it is impossible."""
        lens = self.lens
        return Lens(self.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion)

    def homing_shift_mm(self, before: int, after: int) -> tuple[float, float, float] | None:
        """Return the shift from one homing to another, of which either may be the later; None if it is not known."""
        known: dict[int, NDArray[np.float64]] = {before: np.zeros(3)}
        waiting = [before]
        while waiting:
            here = waiting.pop()
            for homing in self.homings or ():
                for start, end, sign in ((homing.before, homing.after, 1.0), (homing.after, homing.before, -1.0)):
                    if start == here and end not in known:
                        known[end] = known[here] + sign * np.array(homing.shift_mm)
                        waiting.append(end)
        return (*known[after].tolist(),) if after in known else None


def camera_poses(rig: "RigGeometry") -> CameraPoses:
    """Return lens and poses of a geometry as they are recorded."""
    lens = rig.lens
    numbers = lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, tuple(lens.distortion)
    lens_sigma = tuple(np.sqrt(np.diag(rig.covariance)[: len(lens.parameters)]).tolist())
    poses = zip(rig.nodes, rig.rt_cam_ref.tolist(), rig.sigma_mm().tolist(), rig.sigma_rad().tolist(), strict=True)
    return CameraPoses(
        lens=LensRecord(rig.lens_model, *numbers, lens_sigma),
        size_px=lens.size_px,
        reference_node=rig.nodes[rig.reference],
        nodes=[NodeRecord(*pose) for pose in poses],
        homings=[_homing_record(shift) for shift in rig.homings] or UNSET,
    )


def _homing_record(shift: "HomingShift") -> HomingRecord:
    (x, y, z), sigmas = shift.shift_mm.tolist(), np.sqrt(np.diag(shift.covariance_mm2)).tolist()
    return HomingRecord(shift.before, shift.after, (x, y, z), (sigmas[0], sigmas[1], sigmas[2]))


class PosesOfSession(CameraPoses, frozen=True, kw_only=True):
    """The poses, what they were measured from, and the hashes of the files beside them, if any.

    The homings are those of one session only.
    """

    inputs: dict[str, str] = {}
    sha256: dict[str, str] = {}


class BoardRecord(Struct, frozen=True):
    """A board during one sweep.

    Attributes
    ----------
    name : str
        Name of the board.
    columns, rows : int
        Number of squares across; number of squares down.
    square_mm, marker_mm : float
        Edge length of a square; edge length of a marker.
    dictionary : str
        Name of OpenCV's dictionary of markers.
    first_marker_id : int
        Number of the first marker in the dictionary.
    sweep : int
        Number of the sweep.
    rt_ref_board : tuple of float
        Rodrigues vector in rad and translation in mm, from the board's frame to the reference camera's.
    warp_mm : (float, float)
        Height of the bulge at the middle of the board, along x and along y.
    homing : int, optional
        Number of the last homing before, if a homing shifted the cameras within the sweep.
    """

    name: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str
    first_marker_id: int
    sweep: int
    rt_ref_board: Pose
    warp_mm: tuple[float, float]
    homing: int | UnsetType = UNSET


class GeometryOptions(Struct, frozen=True):
    """The options of `faintfield geometry` as they took effect.

    Attributes
    ----------
    lens : str
        Lens model.
    depth_mm : tuple of float
        Depths at which the transfer between views must be known.
    limit_px : float
        Largest standard deviation of the transfer that is accepted.
    """

    lens: str
    depth_mm: tuple[float, ...]
    limit_px: float


class GeometryRecord(CameraPoses, frozen=True, kw_only=True):
    """`geometry.json`: lens and poses, how well they are known, and how they were found.

    It holds the SHA-256 of the files beside it; records of earlier versions do not.

    Attributes
    ----------
    rms_inlier_px : float
        Residual of the corners, rms per axis over the inliers.
    rms_mrcal_px : float
        Residual as mrcal states it: rms distance over all corners, masked ones included.
    corner_sigma_px : float
        Standard deviation of a typical corner, per axis, estimated from the residuals.
    corners, outliers : int
        Number of corners that were fitted; number of corners that were left out.
    holdout_ratio : float, optional
        Residual of boards left out of the fit over that of the fit; null if no board could be left out.
    warnings : list of str
        Problems of the views and of the fit.
    transfer_sigma_px : dict of float
        Standard deviation of a point that is transferred between views, by depth in mm; rms over views and image.
    repeatability : Repeatability, optional
        Repeatability of the stage; null with a single sweep.
    boards : list of BoardRecord
        Pose of each board in each sweep.
    stage : StageReport
        Errors of the stage.
    command : str
        Name of the command that made the result.
    options : GeometryOptions
        Options of the command as they took effect.
    inputs : dict of str
        SHA-256 of each file that was read, by its name.
    versions : dict of str
        Versions of Python and of the packages that computed the result.
    sha256 : dict of str, optional
        SHA-256 of each file beside the record, by its name.
    """

    rms_inlier_px: float
    rms_mrcal_px: float
    corner_sigma_px: float
    corners: int
    outliers: int
    holdout_ratio: float | None
    warnings: list[str] = msgspec.field(name="doubts")
    transfer_sigma_px: dict[str, float]
    repeatability: Repeatability | None
    boards: list[BoardRecord]
    stage: StageReport
    command: str
    options: GeometryOptions
    inputs: dict[str, str]
    versions: dict[str, str]
    sha256: dict[str, str] | UnsetType = UNSET


def read_geometry[Kind: CameraPoses](path: Path, kind: type[Kind]) -> Kind:
    """Read geometry.json, or that of a folder, whole or only the camera's poses."""
    path = path / GEOMETRY_FILE if is_folder(path) else path
    if not is_file(path):
        remedy = "run `faintfield geometry` on the board set first, or `faintfield align` on a set"
        raise MissingFile(f"{path}: no such file; {remedy}")
    geometry = read_json(path, kind, what="the result of `faintfield geometry` or `align`", remedy="run that again")
    try:
        geometry.camera_lens()
    except ValueError as failure:
        raise BadValue(f"{path}: lens: {failure}; run `faintfield geometry` again") from failure
    return geometry


def write_geometry(out: Path, record: "GeometryRecord | AlignmentRecord", files: Mapping[str, bytes | str]) -> None:
    """Write geometry.json and the files beside it into `out`.

    All are written aside first, so that an earlier result stays if the disk is full. geometry.json is removed first and
    put in place last: where it stands, it vouches for the files beside it.
    """
    with exclusive(out), translated_write_errors(out):
        new = out / f".geometry{UNFINISHED}"
        try:
            for name, content in files.items():
                write_whole(new / name, content)
            hashes = {name: sha256(new / name) for name in files}
            write_record(new / GEOMETRY_FILE, msgspec.structs.replace(record, sha256=hashes))
            remove(out / GEOMETRY_FILE)
            if (cameras := (out / CAMERA_FILE).parent).is_symlink():  # files are written and removed in `out` alone
                remove(cameras)
            remove_leftovers(cameras)
            for earlier in out.glob(CAMERA_FILE.format("*", "*")):
                remove(earlier)  # the node may not be part of the new geometry
            for name in (*files, GEOMETRY_FILE):
                (out / name).parent.mkdir(exist_ok=True)
                os.replace(new / name, out / name)
        finally:
            shutil.rmtree(new, ignore_errors=True)
