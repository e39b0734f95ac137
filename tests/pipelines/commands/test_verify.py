"""Results vouch for themselves: whatever is altered in a record or beside it is found, and made again."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from faintfield.pipelines.commands.capture import verify
from faintfield.pipelines.errors import BadValue, ResultDamaged
from faintfield.pipelines.formats.provenance import DIGEST_KEY, digest_holds, with_digest
from faintfield.pipelines.formats.results.surface import results_below
from faintfield.pipelines.formats.results.verification import records_below, records_of, verify_results
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command, assert_refused, run_undrawn
from tests.pipelines.forms import files_in, flip_last_bit

PLANES = 5
SWEEP = ("--sweep-mm", f"500:700:{PLANES}", "--passes", "2", "--penalty-weight", "0.1", "--uncertainty")


@pytest.fixture(scope="module")
def swept(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sweep beside its set, to be read only."""
    folder = tmp_path_factory.mktemp("swept")
    shutil.copytree(simulated_scene, folder / "scene")
    run_undrawn("reconstruct", folder / "scene", "--out", folder / "planes", *SWEEP)
    return folder


@pytest.fixture
def planes(swept: Path, tmp_path: Path) -> Path:
    """A copy of the sweep that a test may change, beside its set."""
    shutil.copytree(swept / "scene", tmp_path / "scene", symlinks=True)
    return Path(shutil.copytree(swept / "planes", tmp_path / "planes"))


def _alterations(content: bytes, count: int) -> Iterator[bytes]:
    """Yield the text of a record with one digit changed, at places all over it."""
    digits = [match.start() for match in re.finditer(rb"[0-9]", content)]
    for place in digits[:: len(digits) // count][:count]:
        yield content[:place] + b"%d" % (int(content[place : place + 1]) % 9 + 1) + content[place + 1 :]


def _contents(folder: Path) -> dict[str, bytes]:
    return files_in(folder, "reconstruction.json", "report.html")  # which state times


def _problems(path: Path) -> tuple[str, ...]:
    return verify_results(records_of(path)).problems


def test_fresh_results_have_no_problems(swept: Path) -> None:
    found = verify(swept / "planes").results
    assert found is not None
    assert (found.records, found.problems, found.unchecked) == (PLANES + 3, (), ())
    assert found.files == 3 * PLANES
    assert found.inputs >= 10


def test_every_value_of_record_is_vouched_for(planes: Path) -> None:
    for name in ("plane_00500.0.json", "reconstruction.json", "overview.json"):
        path = planes / name
        whole = path.read_bytes()
        damaged = [b"[" * 100_000, b"\xff\xfe", b'{"planes": {"a": 1}}', b"{}"]
        for altered in (*_alterations(whole, 20), *damaged):
            path.write_bytes(altered)
            assert any(name in problem for problem in _problems(path)), altered
        path.write_bytes(whole)
    assert _problems(planes) == ()


def test_planes_with_altered_records_are_made_again(swept: Path, planes: Path, done: Command) -> None:
    altered, unreadable, *_ = sorted(planes.glob("plane_*.json"))
    sigma = planes / "plane_00700.0_sigma.tiff"
    sigma.write_bytes(sigma.read_bytes()[:-4] + b"\0\0\x80\x3f")
    altered.write_bytes(list(_alterations(altered.read_bytes(), 9))[1])
    unreadable.write_bytes(b"[" * 100_000)
    assert _contents(planes) != _contents(swept / "planes")
    message = done("reconstruct", planes.with_name("scene"), "--out", planes, *SWEEP).stderr
    assert f"2 of {PLANES} planes are there" in message
    assert _contents(planes) == _contents(swept / "planes")
    assert "was altered" in message
    assert f"{unreadable}: is damaged; it is made again" in message


class TestReading:
    """Report, view and exports read what a record names only in its own folder."""

    def test_name_that_leads_elsewhere_is_refused(self, planes: Path) -> None:
        path = planes / "reconstruction.json"
        content = json.loads(path.read_bytes())
        for name in ("/etc/passwd", "../planes/plane_00500.0.tiff", "a\0b"):
            content["planes"][0]["sigma_file"] = name
            write_by_hand(path, content)
            with pytest.raises(BadValue, match="is not a result that can be shown"):
                results_below(planes)

    def test_pipe_or_link_out_of_folder_is_refused(self, planes: Path) -> None:
        plane = planes / "plane_00500.0.tiff"
        plane.unlink()
        plane.symlink_to(planes.with_name("scene") / "view_r0_c0.tiff")
        with pytest.raises(BadValue, match=r"plane_00500.0.tiff: leads out of the folder"):
            results_below(planes)
        plane.unlink()
        os.mkfifo(plane)
        with pytest.raises(BadValue, match=r"plane_00500.0.tiff: .* is no regular file"):
            results_below(planes)
        assert any("no regular file" in problem for problem in _problems(planes))

    def test_record_that_disagrees_with_digest_is_refused(self, planes: Path, faintfield: Command) -> None:
        path = planes / "reconstruction.json"
        path.write_bytes(path.read_bytes().replace(b'"flux_e": ', b'"flux_e": 1', 1))
        assert_refused(faintfield("report", planes), "BadValue", "was altered after it was written")

    def test_record_without_digest_is_shown(self, planes: Path, done: Command) -> None:
        for path in planes.glob("*.json"):
            write_by_hand(path, json.loads(path.read_bytes()))
        done("report", planes)
        assert "has no digest" in done("verify", planes).stderr


class TestVerify:
    """`faintfield verify` of results."""

    def test_every_file_beside_record_is_compared(self, planes: Path, faintfield: Command) -> None:
        for name in ("plane_00500.0.png", "plane_00500.0_sigma.tiff"):
            path = planes / name
            whole = path.read_bytes()
            flip_last_bit(path)
            assert_refused(faintfield("verify", planes), "ResultDamaged", f"problem: {path}: was altered")
            path.unlink()
            assert f"{path}: is missing" in faintfield("verify", planes / "reconstruction.json").stderr
            path.write_bytes(whole)
        assert faintfield("verify", planes).returncode == 0

    def test_missing_record_or_digest_is_found(self, planes: Path) -> None:
        path = planes / "plane_00500.0.json"
        write_by_hand(path, json.loads(path.read_bytes()))
        for _ in range(2):
            assert any("plane_00500.0.json, which it repeats, is missing" in problem for problem in _problems(planes))
            path.unlink(missing_ok=True)

    def test_inputs_are_compared_where_they_are(self, planes: Path, faintfield: Command, tmp_path: Path) -> None:
        view = planes.with_name("scene") / "view_r0_c0.tiff"
        view.write_bytes(view.read_bytes() + b"\0")
        words = "view_r0_c0.tiff was altered since it was made from it"
        assert_refused(faintfield("verify", planes), "ResultDamaged", words)
        scene = Path(shutil.move(planes.with_name("scene"), tmp_path / "deep" / "below"))
        ended = faintfield("verify", planes)
        assert ended.returncode == 0
        assert "not checked: " in ended.stderr
        assert "not found; name their folder by --inputs" in ended.stderr
        assert faintfield("verify", planes, "--inputs", scene).returncode == 1
        assert "no such folder" in faintfield("verify", planes, "--inputs", tmp_path / "absent").stderr


def test_digest_ignores_white_space_between_values() -> None:
    content = with_digest(b'{"a": 1.0, "b": {"c": "x  y"}}')
    assert digest_holds(content) is True
    assert digest_holds(json.dumps(json.loads(content)).encode()) is True
    assert digest_holds(content.replace(b"1.0", b"1.00")) is False
    assert digest_holds(content.replace(b"x  y", b"x y")) is False
    assert digest_holds(content.rstrip()[:-1] + b', "later": 1}') is False
    assert digest_holds(b'{"a": 1.0}') is None


def test_set_with_same_images_is_meant(planes: Path, done: Command) -> None:
    other = shutil.copytree(planes.parent / "scene", planes.parent / "another", symlinks=True)
    shutil.copyfile(other / "view_r0_c1.tiff", other / "view_r0_c0.tiff")
    assert "from another" not in done("verify", planes).stderr
    shutil.rmtree(planes.parent / "scene")
    with pytest.raises(ResultDamaged, match=r"view_r0_c0\.tiff .* since it was made from it"):
        verify(planes)


@pytest.mark.parametrize("key", ["sha256", "inputs"])
def test_files_outside_folder_are_not_read(key: str, planes: Path) -> None:
    path = planes / "plane_00500.0.json"
    content = json.loads(path.read_bytes())
    content[key] |= {"/dev/zero": "0" * 64, "../scene/view_r0_c0.tiff": "0" * 64}
    del content[DIGEST_KEY]
    path.write_bytes(with_digest(json.dumps(content).encode()))
    with pytest.raises(ResultDamaged):
        verify(planes)


def test_results_behind_link_are_not_shown(planes: Path, tmp_path: Path) -> None:
    (tmp_path / "apart").mkdir()
    (tmp_path / "apart" / "method").symlink_to(planes, target_is_directory=True)
    (tmp_path / "apart" / "noise.json").symlink_to(planes / "reconstruction.json")
    assert records_below(tmp_path / "apart") == []
    assert records_below(planes) != []
