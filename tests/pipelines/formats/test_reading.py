"""Files of any content are read or refused by a named failure; larger ones than expected are never decoded."""

import contextlib
import errno
import fcntl
import io
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.errors import BadValue, CannotWrite, InputError, MissingFile, UnreadableImage, WrongSize
from faintfield.pipelines.formats.exchange.mrcal import read_camera_models
from faintfield.pipelines.formats.files import Hashes, exclusive, sha256
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.reading import is_file, is_folder, read_arrays, read_content, read_json
from faintfield.pipelines.formats.toml_files import inside, read_toml
from tests.patience import HANG_S


class _Settings(msgspec.Struct, forbid_unknown_fields=True):
    format: Literal[1]
    value: Any = None


def test_pipes_and_impossible_names_are_missing_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tiff")
    with pytest.raises(MissingFile):
        sha256(tmp_path / "pipe.tiff")
    for name in ("x" * 5000, "x\0y", "pipe.tiff"):
        path = tmp_path / name
        assert not is_file(path)
        assert not is_folder(path)
        for read in (read_frame, read_content, lambda path: read_toml(path, _Settings, remedy="name one")):
            with pytest.raises(MissingFile):
                read(path)
    with pytest.raises(BadValue, match="name a file inside it"):
        inside(tmp_path, "x\0y", "file")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("format = 1\nvalue = " + "[" * 900 + "]" * 900, "nested too deeply"),
        ("format = 1\nvalue = 0x" + "f" * 5000, "an integer of 20000 bits"),
        ("format = 1\nvalue = 1e999", "value = inf"),
        ("format = 1\n" + "a." * 40 + "a = 1", "line 2: a key has more than 32 parts"),
        ("#" * 8_000_001, "at most 8000000 are read"),
    ],
)
def test_hostile_toml_is_refused(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(content)
    with pytest.raises(InputError, match=words) as refused:
        read_toml(tmp_path / "rig.toml", _Settings, remedy="name one")
    assert str(refused.value).startswith(f"{tmp_path / 'rig.toml'}: ")
    # Dots in text and in lists of numbers are no long key
    (tmp_path / "rig.toml").write_text("format = 1\nvalue = ['" + "a b." * 40 + "', " + "0.5, " * 100 + "]")
    assert len(read_toml(tmp_path / "rig.toml", _Settings, remedy="name one").value) == 101


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"format": 1e999}', b"\xff\xfe", b""])
def test_hostile_json_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "noise.json").write_bytes(content)
    with pytest.raises(BadValue, match=r"noise\.json: is not a record \(.*\); make it again"):
        read_json(tmp_path / "noise.json", _Settings, what="a record", remedy="make it again")


def _npz(header: bytes, content: bytes = b"", **options: Any) -> bytes:
    """Return a .npz file with one member `map`, given the text of its header."""
    whole = io.BytesIO()
    member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content
    with zipfile.ZipFile(whole, "w", **options) as archive:
        archive.writestr("map.npy", member)
    return whole.getvalue()


def _header(shape: object, dtype: str = "<f4") -> bytes:
    return f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()


def _read_map(path: Path) -> dict[str, Any]:
    return read_arrays(path, ["map", "other"], shape=(3, 4), max_bytes=10_000, remedy="make it again")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_npz(_header((1_000_000, 1_000_000))), r"map has shape \(1000000, 1000000\), expected is \(3, 4\)"),
        (_npz(_header((3, 4), "|O"), b"x" * 96), "map is object"),
        (_npz(_header((3, 4)), bytes(47)), "does not have the 48 bytes"),
        (_npz(_header((3, 4)), bytes(20_000_000), compression=zipfile.ZIP_DEFLATED), "does not have the 48 bytes"),
        (_npz(b"{'descr': [[", bytes(48)), ""),
        (bytes(1_100_000), "holds 1100000 bytes"),
    ],
)
def test_arrays_unlike_their_header_are_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "maps.npz").write_bytes(content)
    with pytest.raises(BadValue, match=rf"maps\.npz: cannot be read \(.*{words}.*; make it again"):
        _read_map(tmp_path / "maps.npz")


@pytest.mark.parametrize(("save", "order"), [(np.savez, "C"), (np.savez_compressed, "F")])
def test_arrays_are_read_as_written_or_refused(
    save: Callable[..., None], order: Literal["C", "F"], tmp_path: Path
) -> None:
    """A changed byte is noticed."""
    array = np.array(np.random.default_rng(20110919).normal(size=(3, 4)), np.float32, order=order)
    path = tmp_path / "maps.npz"
    save(path, map=array, unread=np.zeros(3))
    arrays = _read_map(path)
    assert list(arrays) == ["map"]
    np.testing.assert_array_equal(arrays["map"], array)
    save(path, map=array)
    whole = path.read_bytes()
    refused, places = 0, range(0, len(whole), 2)
    for place in places:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x41]) + whole[place + 1 :])
        try:
            arrays = _read_map(path)
        except BadValue:
            refused += 1
        else:  # the byte is of no consequence, or of a name
            assert not arrays or np.array_equal(arrays["map"], array)
    assert refused > len(places) // 2


# Reads frames, and prints how each was refused and by how many MB the process grew.
_READ_FRAMES = """
import resource, sys
from pathlib import Path
from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[1:]:
    try:
        read_frame(Path(name))
    except InputError as failure:
        print(type(failure).__name__, failure)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1000)
"""


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _tiff(path: Path, size_px: int, content: bytes, next_page: int = 0, compression: int = 8) -> None:
    """Write a TIFF of 8-bit grey whose one strip is `content`."""
    entries = [(256, size_px), (257, size_px), (258, 8), (259, compression), (262, 1), (273, 122), (277, 1)]
    entries += [(278, size_px), (279, len(content))]
    page = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + page + struct.pack("<I", next_page) + content)


@pytest.mark.deep
def test_bombs_are_refused_before_they_are_decoded(tmp_path: Path) -> None:
    squeezed = zlib.compressobj(9)
    bomb = b"".join([*(squeezed.compress(bytes(10_000_000)) for _ in range(40)), squeezed.flush()])
    _tiff(tmp_path / "size.tiff", 40_000, zlib.compress(bytes(1000)))
    _tiff(tmp_path / "strip.tiff", 40, bomb)
    _tiff(tmp_path / "circle.tiff", 40, bytes(1600), next_page=8, compression=1)
    ihdr = _chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0))
    idat = _chunk(b"IDAT", bomb) + _chunk(b"IEND", b"")
    (tmp_path / "size.png").write_bytes(b"\x89PNG\r\n\x1a\n" + ihdr + idat)
    frame = struct.pack(">BBHBHHB", 0xFF, 0xC0, 11, 8, 65_500, 65_500, 1) + b"\1\x11\0"
    (tmp_path / "size.jpg").write_bytes(b"\xff\xd8" + frame + b"\xff\xd9")
    (tmp_path / "long.tiff").write_bytes((tmp_path / "circle.tiff").read_bytes()[:100])
    names = ["size.tiff", "strip.tiff", "circle.tiff", "size.png", "size.jpg", "long.tiff"]
    words = [sys.executable, "-c", _READ_FRAMES, *(str(tmp_path / name) for name in names)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    *lines, grown_mb = ended.stdout.splitlines()
    sizes = [f"{side} x {side} px" for side in (40_000, 30_000, 65_500)]
    reasons = [sizes[0], "decompresses to more", "several pictures", *sizes[1:], ""]
    for name, line, reason in zip(names, lines, reasons, strict=True):
        assert line.startswith(f"UnreadableImage {tmp_path / name}: ")
        assert reason in line
    assert int(grown_mb) < 200  # the strip alone would take 400, and the picture in the PNG 900


def test_frame_of_another_size_is_never_decoded(tmp_path: Path) -> None:
    _tiff(tmp_path / "frame.tiff", 4000, b"no pixels at all")
    with pytest.raises(WrongSize, match=r"frame\.tiff: is 4000 x 4000 px, the first frame 40 x 30 px"):
        read_frame(tmp_path / "frame.tiff", (40, 30), of="the first frame")
    with pytest.raises(UnreadableImage):
        read_frame(tmp_path / "frame.tiff", (4000, 4000))
    pixels = np.arange(1200, dtype=np.uint16).reshape(30, 40)
    with tifffile.TiffWriter(tmp_path / "thumbnail.tiff") as file:
        file.write(pixels)
        file.write(pixels[:3, :4])
    np.testing.assert_array_equal(read_frame(tmp_path / "thumbnail.tiff").pixels_dn, pixels)


MODEL = {
    "lensmodel": "LENSMODEL_OPENCV4",
    "intrinsics": [500.0, 500.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0],
    "extrinsics": [0.0, 0.0, 0.0, 0.1, 0.0, 0.0],
    "imagersize": [640, 480],
}


def test_camera_model_is_read_without_its_measurements(tmp_path: Path) -> None:
    text = repr(MODEL)[:-1] + ", 'icam_intrinsics': 0, 'optimization_inputs': b'" + "x!" * 1_000_000 + "'}"
    (tmp_path / "view.cameramodel").write_text(f"# written by hand\n{text}\n")
    (tmp_path / "view.tiff").touch()
    (posed,) = read_camera_models(tmp_path, tmp_path).values()
    assert (posed.lens.size_px, posed.lens.distortion) == ((640, 480), (0.1, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(posed.rt_cam_world, MODEL["extrinsics"])


def test_hostile_camera_model_is_not_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    sizes = [repr(MODEL | {"intrinsics": [1.0] * 3}), repr(MODEL | {"imagersize": [200_000, 200_000]})]
    for text in ("__import__('pathlib').Path('made').touch()", *sizes, "[" * 50_000, ""):
        (tmp_path / "view.cameramodel").write_text(text)
        with pytest.raises(BadValue, match=r"view\.cameramodel: "):
            read_camera_models(tmp_path, tmp_path)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(("number", "refused"), [(errno.EIO, True), (errno.ENOLCK, False)])
def test_failing_lock_is_named_unless_unsupported(
    number: int, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", fail)
    expected = pytest.raises(CannotWrite, match=r"results: cannot be locked") if refused else contextlib.nullcontext()
    with expected, exclusive(tmp_path / "results"):
        assert not refused
        assert (tmp_path / "results").is_dir()


def test_only_own_hashes_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frame"
    path.write_bytes(b"as it was")
    os.utime(path, ns=(10**18, 10**18))
    state = path.stat()
    claimed = {"size": state.st_size, "mtime_ns": state.st_mtime_ns, "sha256": "0" * 64}
    for claim in (claimed, claimed | {"ctime_ns": state.st_mtime_ns, "inode": state.st_ino}):
        (tmp_path / ".hashes.json").write_bytes(msgspec.json.encode({"frame": claim}))
        assert Hashes(tmp_path).of("frame") == sha256(path)
    hashes = Hashes(tmp_path)
    digest = hashes.of("frame")
    hashes.save()
    monkeypatch.setattr("faintfield.pipelines.formats.files.sha256", lambda _: pytest.fail("hashed again"))
    assert Hashes(tmp_path).of("frame") == digest
