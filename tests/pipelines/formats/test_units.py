"""Units: records named and converted by those of their set, and none that nobody gave in anything that is written."""

import dataclasses
import html
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import PlaneFileRecord, ReconstructionRecord
from faintfield.pipelines.formats.sets.elemental_file import read_set_file, write_set
from faintfield.pipelines.formats.sets.elemental_set import load_set, plane_stem, rounded_depth
from faintfield.pipelines.formats.units import DepthUnit, LightUnit, StatedUnits, Units, json_of, record_of
from tests.pipelines.conftest import SMALL, Command, made_once, run_undrawn
from tests.pipelines.formats.results.test_golden import KINDS
from tests.pipelines.forms import GOLDEN, read_record

BRIGHT = ("--snr", 60, "--position-error-mm", 0, "--rotation-error-mrad", 0, "--objects", "surfaces")

# What states a unit, in words, keys and names; options of the command line are not meant.
UNITS_IN_TEXT = {
    "mm": re.compile(r"(?<![\w-])mm\b|_mm\b|_mm(?=[_.])|millimet|µm"),
    "electrons": re.compile(r"e⁻|electron|photon|_e2?\b", re.IGNORECASE),
    "s": re.compile(r"\d s\b|exposure_s\W+[\d.]+"),
}

QUICK = ("--penalty-weight", 1, "--passes", 2)
BACK = ("--method", "backprojection")

# Times that were measured: of the command itself.
WALL_TIMES = re.compile(
    r"in \d+\.\d s\b|wall time, s|: (\d+ of \d+, )?\d+ s(, about \d+ (s|min) to go)?( \([a-z ]+\))?$", re.MULTILINE
)

# TIFF's tag of the unit of its resolution, and the value for the centimetre.
RESOLUTION_UNIT, CENTIMETRE = 296, 3


# The golden records that are made of a set.
RECORDS = [
    pytest.param(path, kind, id=path.stem)
    for name, kind in KINDS.items()
    for path in sorted(GOLDEN.glob(f"{name}_*.json"))
    if path.stem != "metrics_demo" and "units" in kind.__struct_fields__  # the former is also of a calibration
]


@pytest.mark.parametrize(("depth", "light"), [("relative", "dn"), ("disparity_px", "relative")])
@pytest.mark.parametrize(("path", "kind"), RECORDS)
def test_records_are_read_as_written_in_any_units(
    path: Path, kind: type[msgspec.Struct], depth: DepthUnit, light: LightUnit
) -> None:
    record: Any = msgspec.json.decode(path.read_bytes(), type=kind)
    record = msgspec.structs.replace(record, units=StatedUnits(depth, light))
    if hasattr(record, "quantum_efficiency"):
        bare = msgspec.structs.replace(record.brightness, photons_linear=None, photons_from_moments=None)
        record = msgspec.structs.replace(record, quantum_efficiency=None, brightness=bare)
    content = json_of(record)
    assert record_of(content, kind) == record
    assert not re.findall(rb'"\w+(?:_mm|_e2?)":|"\w*(?:electrons|photons_from|photons_lin|efficiency)\w*":', content)


def test_key_of_a_user_is_kept() -> None:
    record = msgspec.json.decode((GOLDEN / "plane_pmlem.json").read_bytes(), type=PlaneFileRecord)
    options = dataclasses.replace(record.options, plane_pose={"depth": [0.0] * 6, "mean": [1.0] * 6})
    units = StatedUnits("relative", "relative")
    odd = msgspec.structs.replace(record, options=options, units=units, inputs={"mean_e": "0" * 64})
    assert record_of(json_of(odd), PlaneFileRecord) == odd
    assert json.loads(json_of(odd))["inputs"] == {"mean_e": "0" * 64}


def test_range_to_infinity_is_said_in_words() -> None:
    assert StatedUnits().range_text(179.677, 1.79677e6) == "180 mm and infinity"
    assert StatedUnits().range_text(400, 900) == "400 and 900 mm"
    assert StatedUnits(depth="disparity_px").range_text(-3.5, 0.8) == "disparities -3.5 and 0.8 px"


def test_negative_depth_is_read_as_disparity_only() -> None:
    content = (GOLDEN / "plane_pmlem.json").read_bytes().replace(b'"depth_mm": 500.0', b'"depth_mm": -500.0')
    with pytest.raises(msgspec.ValidationError, match="a depth is below"):
        record_of(content, PlaneFileRecord)
    content = content.replace(b"depth_mm", b"disparity_px").replace(b'"mm"', b'"disparity_px"')
    content = content.replace(b"pitch_mm", b"pitch_px").replace(b"origin_mm", b"origin_px")
    assert record_of(content, PlaneFileRecord).planes[0].depth_mm == -500.0


@pytest.fixture(scope="module")
def with_scale(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bright set in mm and electrons, of 9 views, at exactly the nodes of a grid."""
    words = ("simulate", *SMALL, *BRIGHT)
    return made_once(tmp_path_factory, "units", lambda folder: run_undrawn(*words, folder / "set")) / "set"


def without_scale(folder: Path, depth: DepthUnit, light: LightUnit) -> Path:
    """Make a set one whose depth and light are in these units, and whose exposure is not known."""
    settings = read_set_file(folder / "elemental.toml")
    noise = settings.noise
    assert not isinstance(noise, str)
    noise = msgspec.structs.replace(noise, dark_current_e_per_s=0.0, quantum_efficiency=None)
    changed = msgspec.structs.replace(settings, units=Units(depth, light), exposure_s=None, noise=noise)
    write_set(folder, changed)
    return folder


@pytest.fixture
def imported(with_scale: Path, tmp_path: Path, done: Command, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """Return a set of the pictures alone, by disparity and with 1 = white, and the words of its import.

    Only deep tests find the poses by the views.
    """
    quick = () if request.node.get_closest_marker("deep") else ("--no-align",)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for path in with_scale.glob("view_*.tiff"):
        shutil.copy(path, pictures)
    ended = done("import", "grid", pictures, tmp_path / "set", "--offset-dn", 100, "--read-noise-e", 3, *quick)
    return without_scale(tmp_path / "set", "disparity_px", "relative"), ended.stdout + ended.stderr


def test_planes_are_written_in_units_of_set(tmp_path: Path, done: Command) -> None:
    """The same set in DN, and relative to white, gives the same planes times the gain, and times that over white."""
    scene, planes, records = tmp_path / "scene", {}, {}
    done("simulate", scene, "--size-px", 32, 24, "--rows", 2, "--columns", 2, "--snr", 60)
    for light in ("electrons", "dn", "relative"):
        folder = Path(shutil.copytree(scene, tmp_path / light / "set"))
        settings = read_set_file(folder / "elemental.toml")
        write_set(folder, msgspec.structs.replace(settings, units=Units("mm", light)))
        out = tmp_path / light / "out"
        done("reconstruct", folder, "--out", out, "--depth-mm", 700, "--prior", "tv", *QUICK, "--uncertainty")
        planes[light] = [read_frame(out / f"plane_00700.0{name}.tiff").pixels_dn for name in ("", "_sigma")]
        records[light] = record_of((out / "reconstruction.json").read_bytes(), ReconstructionRecord)
    noise = load_set(scene).settings.noise
    assert not isinstance(noise, str)
    assert noise.saturation_dn is not None
    white_dn = noise.saturation_dn - (noise.offset_dn or 0)
    for light, factor in (("dn", noise.gain_dn_per_e), ("relative", noise.gain_dn_per_e / white_dn)):
        np.testing.assert_allclose(planes[light], factor * np.array(planes["electrons"]), rtol=1e-5)
        for field in ("mean_e", "flux_e"):
            value, of_electrons = (getattr(records[key].planes[0], field) for key in (light, "electrons"))
            assert value == pytest.approx(factor * of_electrons, rel=1e-6)


def texts_of(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield names, texts, tags of TIFFs and headers of all files, each with the place where it stands."""
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        yield "name", path.relative_to(folder).as_posix()
        if path.suffix == ".html":
            bytes_and_marks = r"(?s)data:[^\"'\s]*|<style>.*?</style>|<svg|<path[^>]*>|<use[^>]*>"
            yield path.name, html.unescape(re.sub(bytes_and_marks, "", path.read_text()))
        elif path.suffix in (".json", ".toml"):
            yield path.name, path.read_text()
        elif path.suffix == ".ply":
            yield path.name, path.read_bytes().partition(b"end_header")[0].decode()
        elif path.suffix == ".tiff":
            with tifffile.TiffFile(path) as file:
                for tag in file.pages.first.tags.values():
                    centimetres = tag.code == RESOLUTION_UNIT and tag.value == CENTIMETRE
                    yield f"{path.name}, {tag.name}", "a pitch in mm" if centimetres else f"{tag.value} "


def stated_units(folder: Path, words: str) -> dict[str, list[str]]:
    """Return the places in a folder, and in the words of its commands, where each unit is stated."""
    places: dict[str, list[str]] = {}
    for where, text in [("terminal", words), *texts_of(folder)]:
        text = WALL_TIMES.sub("", text)
        for unit, pattern in UNITS_IN_TEXT.items():
            for hit in pattern.finditer(text):
                context = text[max(hit.start() - 40, 0) : hit.end() + 20]
                places.setdefault(unit, []).append(f"{where}: …{context}…")
    return places


def outputs(done: Command, folder: Path, out: Path, *calls: tuple[object, ...]) -> str:
    """Make results of a set, a report, and exports of them into folders of `out`; return the words of the commands."""
    for_all = [
        ("report", out),
        ("verify", out, "--inputs", folder),
        ("export", "zarr", out / "sweep", out / "sweep.ome.zarr", "--overwrite"),
        ("export", "colmap", folder, out / "colmap", "--overwrite"),
    ]
    words = ""
    for call in [*(("reconstruct", folder, *call) for call in calls), *(("--json", *call) for call in for_all)]:
        ended = done(*call)
        words += ended.stdout + ended.stderr
    return words


ALL_KINDS_OF_RESULTS = [("--depth-mm", "auto", *BACK), ("--surface", *QUICK)]


@pytest.mark.parametrize(
    ("unit", "sweep", "others"),
    [
        ("disparity_px", "--sweep-px=-14:-4:5", []),
        pytest.param("disparity_px", "--sweep-px=-14:-4:6", ["--disparity-px=-8"], marks=pytest.mark.deep),
        pytest.param("relative", "--sweep=500:1000:6", ["--depth=700"], marks=pytest.mark.deep),
    ],
)
def test_no_output_states_an_unknown_unit(
    unit: DepthUnit, sweep: str, others: list[str], with_scale: Path, imported: tuple[Path, str], tmp_path: Path,
    request: pytest.FixtureRequest, done: Command, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    assert stated_units(with_scale, "").keys() == UNITS_IN_TEXT.keys()
    folder, words = imported
    if not others:
        request.getfixturevalue("seen")
    if unit == "relative":
        folder, words = Path(shutil.copytree(with_scale, tmp_path / "relative")), ""
        for path in [*folder.glob("*.json"), *folder.glob("noise_free*"), *folder.glob("object_region*")]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        without_scale(folder, unit, "dn")
    out, layers = tmp_path / "out", list[dict[str, Any]]()
    kinds = [*((plane, *QUICK, "--uncertainty") for plane in others), *(ALL_KINDS_OF_RESULTS if others else ())]
    calls = [("--out", out / f"{number}", *kind) for number, kind in enumerate(kinds)]
    words += outputs(done, folder, out, ("--out", out / "sweep", sweep, *BACK, "--depth-map"), *calls)
    viewer = SimpleNamespace(add_image=lambda data, **options: layers.append(options))
    monkeypatch.setitem(sys.modules, "napari", SimpleNamespace(Viewer=lambda **_: viewer, run=lambda: None))
    done("view", out / "sweep")
    assert stated_units(out, words) == {}
    if unit == "relative":
        assert "has no scale, so that lengths are relative" in words
        return
    assert layers[0]["units"] == ("pixel",) * 3
    assert layers[0]["axis_labels"] == ("disparity", "y", "x")
    assert "disparit" in words
    record = read_record(out / "sweep")["planes"][0]
    # The reference view has 96 x 72 px, and its principal point in the middle; samples are its pixels
    assert record["disparity_px"] == pytest.approx(-14, abs=1e-6)
    assert record["pitch_px"] == pytest.approx(1.0)
    assert record["origin_px"] == pytest.approx([-47.5, -35.5])
    assert record["file"] == "plane_px_-014.000.tiff"


@pytest.mark.parametrize("unit", ["mm", "relative", "disparity_px"])
def test_rounded_depths_have_their_own_name(unit: DepthUnit, with_scale: Path, tmp_path: Path) -> None:
    elemental_set = load_set(without_scale(Path(shutil.copytree(with_scale, tmp_path / "set")), unit, "electrons"))
    focal_px, pitch_mm = elemental_set.settings.camera.fx_px, 50
    # Half a digit; a disparity of fx p / z changes by that if z does by z² / (fx p)
    half = {"mm": 0.05, "relative": 5e-4, "disparity_px": 5e-4 * 710**2 / (focal_px * pitch_mm)}[unit]
    for depth in np.linspace(690, 710, 41).tolist():
        rounded = rounded_depth(elemental_set, depth)
        assert abs(rounded - depth) <= 1.01 * half
        assert rounded_depth(elemental_set, rounded) == pytest.approx(rounded, rel=1e-12)
        assert plane_stem(elemental_set, rounded) == plane_stem(elemental_set, rounded * (1 + 1e-9))
    if unit == "relative":
        names = [plane_stem(elemental_set, depth) for depth in (4.6315789, 12.0)]
        assert names == ["plane_rel_4.63158", "plane_rel_12"]
