"""Dark and flat frames exported as EMVA 1288 data are what `import emva1288` reads."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.pipelines.commands.exports.emva1288 import export_emva1288
from faintfield.pipelines.commands.imports.emva1288 import import_emva1288
from faintfield.pipelines.errors import BadValue, OutputExists
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, group_frames, load_noise_set
from tests.calib.noise.darkroom import specimen
from tests.pipelines.noise_sets import take_set, write_frames


def frames_of(folder: Path) -> tuple[dict[object, list[np.ndarray]], NoiseSet]:
    """The pixels of every frame, by what its series have in common."""
    folder, settings = load_noise_set(folder)
    series = group_frames(folder, settings)
    return {is_of: [read_frame(path).pixels_dn for path in paths] for is_of, paths in series.items()}, settings


def make_set(folder: Path, **settings: object) -> Path:
    chip, rng = specimen(1, shape=(24, 32))
    # A third is no decimal number; levels come in no order.
    return write_frames(folder, take_set(chip, rng, (1 / 3, 10.0), 2, photons=(9000.0, 1000 / 7)), **settings)


def test_what_is_exported_is_imported_again(tmp_path: Path) -> None:
    source = make_set(tmp_path / "set", saturation_dn=4095.0)
    result = export_emva1288(source, tmp_path / "out")
    assert (result.frames, result.bits, result.size_px) == (8, 12, (32, 24))
    import_emva1288(tmp_path / "out" / "descriptor.txt", tmp_path / "again")
    (before, settings), (after, again) = frames_of(source), frames_of(tmp_path / "again")
    assert list(before) == list(after)
    assert again.saturation_dn == settings.saturation_dn
    for is_of, images in before.items():
        assert all(np.array_equal(*pair) for pair in zip(images, after[is_of], strict=True))


def test_the_descriptor_is_of_the_standard(tmp_path: Path) -> None:
    """Bright measurements first, exposures in ns; every image lies where its line says."""
    export_emva1288(make_set(tmp_path / "set"), tmp_path / "out")
    lines = (tmp_path / "out" / "descriptor.txt").read_text().splitlines()
    assert lines[:3] == ["v 4.0", "n 16 32 24", "b 100000000.0 9000.0"]
    assert lines[5].startswith("b 100000000.0 142.857142857142")
    assert lines[8] == "d 333333000.0"
    named = [line[2:].replace("\\", "/") for line in lines if line.startswith("i ")]
    assert sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out" / "images").iterdir()) == named
    first = tifffile.imread(tmp_path / "out" / named[0])
    assert np.array_equal(first, tifffile.imread(tmp_path / "set" / "flat_04.tiff"))


def test_only_the_region_in_use_is_exported(tmp_path: Path) -> None:
    region = {"rows": [4, 20], "columns": [2, 30]}
    source = make_set(tmp_path / "set", region=region)
    assert export_emva1288(source, tmp_path / "out").size_px == (28, 16)
    import_emva1288(tmp_path / "out" / "descriptor.txt", tmp_path / "again")
    (before, _), (after, _) = frames_of(source), frames_of(tmp_path / "again")
    for is_of, images in before.items():
        assert np.array_equal(images[0][4:20, 2:30], after[is_of][0])


def test_a_saturation_between_powers_of_two_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert export_emva1288(make_set(tmp_path / "set", saturation_dn=3500.0), tmp_path / "out").bits == 12
    assert "saturation at 3500 DN cannot be stated" in capfd.readouterr().err


def test_flats_without_photons_are_refused_by_name(tmp_path: Path) -> None:
    chip, rng = specimen(1, shape=(24, 32))
    frames = take_set(chip, rng, (1.0,), 2, photons=(500.0,))
    frames[-1] = (frames[-1][0], {name: it for name, it in frames[-1][1].items() if name != "photons"})
    with pytest.raises(BadValue, match=r"flat_03\.tiff: states no photons"):
        export_emva1288(write_frames(tmp_path / "set", frames), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_earlier_data_are_replaced_only_when_asked(tmp_path: Path) -> None:
    source = make_set(tmp_path / "set")
    for command, marked in (("export", "descriptor.txt"), ("import", "noise.toml")):
        read = source if command == "export" else tmp_path / "export" / "descriptor.txt"
        call = [command, "emva1288", str(read), str(tmp_path / command)]
        assert run(call) == 0
        assert run(call) == 1
        (tmp_path / command / "stale").touch()
        assert run([*call, "--overwrite"]) == 0
        assert not (tmp_path / command / "stale").exists()
        assert (tmp_path / command / marked).exists()


def test_what_is_read_is_never_replaced(tmp_path: Path) -> None:
    source = make_set(tmp_path / "set")
    (source / "descriptor.txt").touch()
    with pytest.raises(OutputExists):
        export_emva1288(source, source, overwrite=True)
    assert (source / "flat_04.tiff").exists()
