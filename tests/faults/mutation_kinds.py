"""The kinds of files that commands read: a small valid folder of each, made by the commands, and the commands."""

import os
import shutil
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import cv2
import msgspec
import numpy as np
import tifffile
import tomli_w

from faintfield.calib.board import Board
from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.formats.toml_files import write_toml
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from tests.calib.noise.darkroom import specimen
from tests.faults.capturing import SMALL_RIG, Operator, capture_small
from tests.pipelines.noise_sets import take_set, write_frames
from tests.pipelines.sessions import captured, rig_toml
from tests.simulated_boards import simulate_board_set

_SIDES_PX = (32, 24)
_BOARD_PX = (320, 240)
_SMALL_RIG = msgspec.structs.replace(SMALL_RIG, camera=SimulatedSettings(size_px=_SIDES_PX))


@dataclass(frozen=True)
class Call:
    """A command on a case's files in `IN`: patterns of files it may change or copies, and what must end well after."""

    words: str
    may_change: tuple[str, ...] = ("OUT", "OUT/*")
    then: str = ""
    copies: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kind:
    """A kind of files: what writes the valid files into a folder, and the commands that read them.

    `files` are patterns of the files that are mutated. In `make deep`, `cases` are tried, each with one of the `calls`.
    """

    seed: Callable[[Path], None]
    files: tuple[str, ...]
    calls: tuple[Call, ...]
    cases: int = 100


def _done(*words: object) -> None:
    assert run([str(word) for word in words]) == 0, words


def _simulated(folder: Path, sides_px: tuple[int, int] = _SIDES_PX, *, snr: float = 100.0) -> None:
    """Write a small set, bright enough to be darkened."""
    _done("simulate", folder, "--size-px", *sides_px, "--rows", 3, "--columns", 3, "--snr", snr)


def _dark_room(folder: Path) -> None:
    chip, rng = specimen(11, shape=_SIDES_PX[::-1])
    write_frames(folder, take_set(chip, rng, frames=3, photons=(2000.0, 8000.0)))


def _measured_noise(folder: Path) -> None:
    _simulated(folder)
    _dark_room(folder / "frames")
    _done("noise", folder / "frames", "--out", folder)
    shutil.rmtree(folder / "frames")
    settings = tomllib.loads((folder / "elemental.toml").read_text())
    settings["noise"] = "noise.json"
    (folder / "elemental.toml").write_text(tomli_w.dumps(settings))


def _boards(folder: Path) -> None:
    _simulated(folder / "scene", _BOARD_PX)
    paper = paper_experiment(*_BOARD_PX)
    experiment = SimulatedExperiment(paper.planes, paper.optics, paper.sensor, 3, 3, 100.0)
    truth = read_truth(folder / "scene")
    assert truth is not None
    boards = [Board(f"b{index}", 9, 7, 40.0, 29.0, "DICT_4X4_250", 31 * index) for index in range(4)]
    simulate_board_set(folder, experiment, np.array(truth.true_rt_cam_ref), boards, np.random.default_rng(1))


def _measured_geometry(folder: Path) -> None:
    _boards(folder)
    _done("geometry", folder, "--out", folder, "--limit-px", 100)
    for path in [*folder.glob("b*.tiff"), folder / "charuco.toml"]:
        path.unlink()


def _pictures(folder: Path) -> None:
    """Write small pictures of all kinds, a stack of four, and a light field of the HCI benchmark with its truth."""
    rng = np.random.default_rng(5)
    grey = rng.integers(0, 4000, _SIDES_PX[::-1]).astype(np.uint16)
    dim = (grey >> 4).astype(np.uint8)
    for name, pixels in {
        "16_bits/view_r0_c1.png": grey[::-1],
        "8_bits/view_r0_c0.png": dim,
        "8_bits/view_r0_c1.jpg": dim[::-1],
        "bmp/view_r0_c0.bmp": dim,
        "pgm/view_r0_c0.pgm": grey,
        "pfm/view_r0_c0.pfm": grey.astype(np.float32),
        "hci/gt_disp_lowres.pfm": (grey / 4000).astype(np.float32),
        **{f"hci/input_Cam00{number}.png": np.roll(dim, number, axis=1) for number in range(9)},
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), pixels)
    write_frame(folder / "16_bits" / "view_r0_c0.tiff", grey)
    stack = np.stack([np.roll(grey, number, axis=1) for number in range(4)])
    tifffile.imwrite(folder / "stack.tif", stack, photometric="minisblack")
    (folder / "hci" / "parameters.cfg").write_text(
        f"[intrinsics]\nfocal_length_mm = 100\nimage_resolution_x_px = {_SIDES_PX[0]}\n"
        f"image_resolution_y_px = {_SIDES_PX[1]}\nsensor_size_mm = 35\n"
        "[extrinsics]\nnum_cams_x = 3\nnum_cams_y = 3\nbaseline_mm = 50\nfocus_distance_m = 6\n"
    )


def _pose_table(folder: Path) -> None:
    _simulated(folder)
    rows = [f"{path.name},{10 * n},0.5,{n},0,0,0,1" for n, path in enumerate(sorted(folder.glob("view_*.tiff")))]
    (folder / "poses.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm,qx,qy,qz,qw", *rows]) + "\n")


def _raw_picture(folder: Path) -> None:
    folder.mkdir(parents=True)
    raw = Path(os.environ["FAINTFIELD_DATA"]) / "raw" / "colorchart.dng"
    shutil.copyfile(raw, folder / "view_r0_c0.dng")


def _exported(*words: str) -> Callable[[Path], None]:
    """Return what writes a model of a simulated set by `faintfield export`, beside the set's images."""

    def write(folder: Path) -> None:
        _simulated(folder)
        _done("export", words[0], folder, folder / "model", *words[1:])
        (folder / "elemental.toml").unlink()

    return write


def _emva1288(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    lines = ["v 4.0", "n 12 32 24"]
    rng = np.random.default_rng(3)
    for number, measurement in enumerate(("b 100000000,0 1000.0", "b 100000000.0 6000.0", "d 100000000.0", "d 3e10")):
        lines.append(measurement)
        for repeat in range(2):
            name = f"{number}_{repeat}.png"
            cv2.imwrite(str(folder / "images" / name), rng.integers(0, 4000, _SIDES_PX[::-1]).astype(np.uint16))
            lines.append(f"i images\\{name}")
    (folder / "descriptor.txt").write_text("\n".join(lines) + "\n")


def _rig(folder: Path) -> None:
    """Write a rig.toml, as `faintfield init` does, and what `faintfield check` stores beside it."""
    folder.mkdir(parents=True)
    _done("init", folder / "rig.toml")
    _done("check", folder / "rig.toml", "--remember")


def _sealed_session(folder: Path) -> None:
    write_toml(folder / "rig.toml", _SMALL_RIG)
    _done("capture", folder / "rig.toml", folder / "session", "--yes")


def _open_session(folder: Path) -> None:
    """Capture ten frames of a session, and leave it."""
    write_toml(folder / "rig.toml", _SMALL_RIG)
    leave = mock.patch.object(Operator, "show_frame", side_effect=[*(None,) * 9, LookupError])
    with leave, suppress(LookupError):
        capture_small(folder / "session", _SMALL_RIG)


def _whole_session(folder: Path) -> None:
    captured(folder, rig_toml())
    _done("run", folder / "session", "--depth-mm", 700, "--method", "backprojection")


def _results(folder: Path) -> None:
    """Reconstruct planes of a simulated set by two methods, with its errors and a depth map."""
    _simulated(folder / "set", snr=20.0)  # at 0.16 its few small views agree no better than shuffled ones
    _done("reconstruct", folder / "set", "--out", folder / "planes", *_PLANES.split())
    _done("reconstruct", folder / "set", "--out", folder / "sweep", *_SWEEP.split())


_PLANES = "--depth-mm 500 --depth-mm 700 --passes 2 --penalty-weight 0.1"
_SWEEP = "--sweep-mm 400:800:5 --depth-map --method backprojection"
_PICTURES = ("8_bits", "16_bits", "bmp", "pgm", "pfm", "stack.tif", "hci")
_NOTHING = ("",)

# A session whose seal is missing is open: frames may be set aside, taken again and sealed.
_IN_SESSION = ("IN/session", "IN/session/*")

_RECONSTRUCT = "reconstruct IN --out OUT --depth-mm 500 --passes 2 --penalty-weight 0.1"
_BACKPROJECT = "reconstruct IN --out OUT --depth-mm 500 --method backprojection"

_OTHER_READERS = ("darken IN OUT", "export colmap IN OUT", "export mrcal IN OUT")
_READ_SET = tuple(Call(words) for words in (_RECONSTRUCT, _BACKPROJECT, *_OTHER_READERS))
_RESUME = Call("capture IN/rig.toml IN/session --yes", _IN_SESSION, then="verify IN/session")

_JOURNAL = "session/journal.sqlite"
_OF_SESSION = ("session/plan.json", _JOURNAL, _JOURNAL, "session/frames/*", "session/lock", "rig.toml")

_VERIFY = Call("verify IN/session", _NOTHING)


def _imports(form: str) -> tuple[Call, ...]:
    return (Call(f"import {form} IN/model OUT --images IN"),)


KINDS: Mapping[str, Kind] = {
    "elemental set": Kind(
        _simulated,
        ("elemental.toml", "elemental.toml", "view_*.tiff", "noise_reference.tiff", "truth.json", "truth/*"),
        _READ_SET,
        cases=250,
    ),
    "raw picture": Kind(_raw_picture, ("view_*",), (Call("import grid IN OUT"),), cases=40),
    "pictures": Kind(
        _pictures,
        ("*/view_*", "*/view_*", "stack.tif", "hci/*.cfg", "hci/*.pfm"),
        tuple(Call(f"import grid IN/{name} OUT") for name in _PICTURES),
        cases=200,
    ),
    "rig": Kind(
        _rig,
        ("rig.toml", "rig*.json"),
        (Call("check IN/rig.toml", _NOTHING), Call("check IN/rig.toml --remember", ("IN/rig*",))),
    ),
    "boards": Kind(
        _boards, ("charuco.toml", "charuco.toml", "b*.tiff"), (Call("geometry IN --out OUT --limit-px 100"),), cases=15
    ),
    "noise set": Kind(
        _dark_room,
        ("noise.toml", "noise.toml", "*.tiff"),
        (Call("noise IN --out OUT"), Call("export emva1288 IN OUT", copies=("OUT/images/*",))),
        cases=40,
    ),
    "noise": Kind(
        _measured_noise,
        ("noise.json", "noise_maps.npz"),
        (
            Call(_RECONSTRUCT),
            Call(_BACKPROJECT),
            Call("darken IN OUT"),
            Call("noise --compare IN IN/noise.json", _NOTHING),
            Call("verify IN", _NOTHING),
        ),
    ),
    "geometry": Kind(
        _measured_geometry,
        ("geometry.json", "geometry.json", "*.npz", "cameras/*"),
        (
            Call("reconstruct IN/scene --geometry IN --out OUT --depth-mm 500 --method backprojection"),
            Call("verify IN", _NOTHING),
        ),
    ),
    "COLMAP text": Kind(_exported("colmap"), ("model/*.txt",), _imports("colmap")),
    "COLMAP binary": Kind(_exported("colmap", "--binary"), ("model/*.bin",), _imports("colmap")),
    "camera models": Kind(_exported("mrcal"), ("model/*.cameramodel",), _imports("mrcal")),
    "transforms": Kind(_exported("nerfstudio"), ("model/*.json",), _imports("nerfstudio")),
    "pose table": Kind(_pose_table, ("poses.csv",), (Call("import poses IN/poses.csv OUT --fx-px 100"),)),
    "EMVA 1288": Kind(
        _emva1288,
        ("descriptor.txt", "descriptor.txt", "images/*"),
        (Call("import emva1288 IN/descriptor.txt OUT", copies=("OUT/frames/*",)),),
    ),
    "complete session": Kind(
        _sealed_session,
        (*_OF_SESSION, "session/SHA256SUMS"),
        (
            *(_VERIFY, _VERIFY, _VERIFY),
            Call("capture IN/rig.toml IN/session --yes", _IN_SESSION),
            Call("noise IN/session --out OUT"),
        ),
    ),
    "open session": Kind(_open_session, _OF_SESSION, (_VERIFY, _RESUME, _RESUME)),
    "measured session": Kind(
        _whole_session,
        (
            *("session/*.json", "session/*.npz", _JOURNAL, "session/SHA256SUMS", "session/.hashes.json"),
            *("session/reconstructions/*", "session/cameras/*"),
        ),
        (
            Call("run IN/session --depth-mm 700 --method backprojection", _IN_SESSION),
            Call("report IN/session", ("IN/session/report.html",)),
            Call("reconstruct IN/session --out OUT --depth-mm 700 --method backprojection"),
            Call("verify IN/session", _NOTHING),
            Call("export colmap IN/session OUT"),
        ),
        cases=30,
    ),
    "results": Kind(
        _results,
        ("planes/*", "planes/*.json", "sweep/*", "sweep/*.json"),
        (
            Call("report IN/planes", ("IN/planes/report.html",)),
            Call("report IN/sweep", ("IN/sweep/report.html",)),
            Call("report IN", ("IN/report.html",)),
            Call(
                f"reconstruct IN/set --out IN/planes {_PLANES}", ("IN/planes", "IN/planes/*"), then="verify IN/planes"
            ),
            Call(f"reconstruct IN/set --out IN/sweep {_SWEEP}", ("IN/sweep", "IN/sweep/*"), then="verify IN/sweep"),
            Call("verify IN/planes", _NOTHING),
            Call("verify IN/sweep", _NOTHING),
            Call("export zarr IN/sweep OUT"),
        ),
    ),
}
