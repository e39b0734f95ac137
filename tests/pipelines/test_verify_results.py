"""Results vouch for themselves: whatever is altered in a record or beside it is found, and made again."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.commands.verify import verify
from faintfield.pipelines.errors import BadValue, ResultDamaged
from faintfield.pipelines.formats.digests import DIGEST_KEY, digest_holds, with_digest
from faintfield.pipelines.formats.results.result_files import results_below
from faintfield.pipelines.formats.results.verification import records_below, records_of, verify_results
from tests.pipelines.by_hand import write_by_hand

type Command = Callable[..., CompletedProcess[str]]

PLANES = 8
SWEEP = ("--sweep-mm", f"500:700:{PLANES}", "--passes", "2", "--penalty-weight", "0.1", "--uncertainty")


@pytest.fixture(scope="module")
def swept(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sweep beside its set, to be read only."""
    folder = tmp_path_factory.mktemp("swept")
    shutil.copytree(simulated_scene, folder / "scene")
    assert run(["reconstruct", str(folder / "scene"), "--out", str(folder / "planes"), *SWEEP]) == 0
    return folder


@pytest.fixture
def planes(swept: Path, tmp_path: Path) -> Path:
    """A copy of the sweep that a test may change, beside its set."""
    shutil.copytree(swept / "scene", tmp_path / "scene", symlinks=True)
    return Path(shutil.copytree(swept / "planes", tmp_path / "planes"))


def _leaves(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to each number, word and empty container of a JSON value."""
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not keys:
        yield way
    for key in keys:
        yield from _leaves(value[key], (*way, key))


def _other(value: Any) -> Any:
    """Return another JSON value of the same type."""
    match value:
        case bool():
            return not value
        case int() | float():
            return value + 1
        case str():
            return ("0" if value[:1] == "1" else "1") + value[1:]
        case _:
            return 1


def _altered(path: Path, way: tuple[Any, ...], change: Callable[[Any], Any] = _other) -> None:
    """Change one value of a record."""
    content = json.loads(path.read_bytes())
    place = content
    for key in way[:-1]:
        place = place[key]
    place[way[-1]] = change(place[way[-1]])
    path.write_text(json.dumps(content, indent=2))


def _contents(folder: Path) -> dict[str, bytes]:
    """Return all files but those that state times."""
    timed = ("reconstruction.json", "report.html")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name not in timed}


def _problems(folder: Path) -> tuple[str, ...]:
    return verify_results(records_of(folder)).problems


def test_what_was_made_now_has_no_problems(swept: Path) -> None:
    found = verify(swept / "planes").results
    assert found is not None
    assert (found.records, found.problems, found.unchecked) == (PLANES + 3, (), ())
    assert found.files == 3 * PLANES
    assert found.inputs >= 10


def test_every_value_of_a_plane_record_is_vouched_for(planes: Path) -> None:
    path = planes / "plane_00500.0.json"
    whole = path.read_bytes()
    ways = list(_leaves(json.loads(whole)))
    assert len(ways) > 50
    for way in ways[::3]:
        _altered(path, way)
        assert any("plane_00500.0.json" in problem for problem in _problems(planes)), way
        path.write_bytes(whole)
    assert _problems(planes) == ()


def test_a_plane_whose_record_was_altered_is_made_again(swept: Path, planes: Path, done: Command) -> None:
    scene = planes.with_name("scene")
    paths = sorted(planes.glob("plane_*.json"))[:-3]
    for number, path in enumerate(paths):
        ways = [way for way in _leaves(json.loads(path.read_bytes())) if way[0] not in ("inputs", "versions")]
        _altered(path, ways[number * len(ways) // len(paths)])
    assert _contents(planes) != _contents(swept / "planes")
    said = done("reconstruct", scene, "--out", planes, *SWEEP).stderr
    assert f"3 of {PLANES} planes are there" in said
    assert _contents(planes) == _contents(swept / "planes")
    assert "was altered" in said


DAMAGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no planes": lambda it: it.pop("planes"),
    "planes of a wrong type": lambda it: it.update(planes={"a": 1}),
    "a device among the files": lambda it: it.update(sha256={"/dev/zero": "0" * 64}),
    "a file elsewhere": lambda it: it["planes"][0].update(file="../plane_00500.0.tiff"),
}


@pytest.mark.parametrize("damage", [pytest.param(damage, id=name) for name, damage in DAMAGES.items()])
def test_a_damaged_plane_record_is_made_again(
    damage: Callable[[dict[str, Any]], Any], scene: Path, tmp_path: Path, done: Command
) -> None:
    out = tmp_path / "out"
    words = ("reconstruct", scene, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    done(*words)
    before = _contents(out)
    path = out / "plane_00500.0.json"
    content = json.loads(path.read_bytes())
    damage(content)
    path.write_text(json.dumps(content))
    assert _problems(out)
    done(*words)
    assert _contents(out) == before


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff\xfe"])
def test_a_record_that_is_none_is_made_again(content: bytes, scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    words = ("reconstruct", scene, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    done(*words)
    before = _contents(out)
    (out / "plane_00500.0.json").write_bytes(content)
    assert f"{out / 'plane_00500.0.json'}: is damaged; it is made again" in done(*words).stderr
    assert _contents(out) == before


class TestReading:
    """Report, view and exports read what a record names only in its own folder."""

    @pytest.mark.parametrize("name", ["/etc/passwd", "../planes/plane_00500.0.tiff", "", "a\0b"])
    def test_a_name_that_leads_elsewhere_is_refused(self, name: str, planes: Path) -> None:
        path = planes / "reconstruction.json"
        content = json.loads(path.read_bytes())
        content["planes"][0]["sigma_file"] = name
        write_by_hand(path, content)
        with pytest.raises(BadValue, match="is not a result that can be shown"):
            results_below(planes)

    def test_results_that_a_link_leads_to_are_not_shown_as_those_of_the_folder(
        self, planes: Path, tmp_path: Path
    ) -> None:
        apart = tmp_path / "apart"
        apart.mkdir()
        (apart / "method").symlink_to(planes, target_is_directory=True)
        (apart / "noise.json").symlink_to(planes / "reconstruction.json")
        assert records_below(apart) == []
        assert records_below(planes) != []

    def test_a_file_that_is_a_pipe_or_a_link_out_is_refused(self, planes: Path) -> None:
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

    def test_a_record_that_disagrees_with_its_digest_is_refused(self, planes: Path, faintfield: Command) -> None:
        _altered(planes / "reconstruction.json", ("planes", 0, "flux_e"))
        ended = faintfield("report", planes)
        assert ended.returncode == 1
        assert "BadValue" in ended.stderr
        assert "was altered after it was written" in ended.stderr

    def test_a_record_without_a_digest_is_shown(self, planes: Path, done: Command) -> None:
        for path in planes.glob("*.json"):
            write_by_hand(path, json.loads(path.read_bytes()))
        done("report", planes)
        said = done("verify", planes).stderr
        assert "not checked: " in said
        assert "has no digest" in said


class TestVerify:
    """`faintfield verify` of results."""

    def test_every_file_beside_a_record_is_compared(self, planes: Path, faintfield: Command) -> None:
        for name in ("plane_00500.0.tiff", "plane_00500.0.png", "plane_00500.0_sigma.tiff"):
            path = planes / name
            whole = path.read_bytes()
            path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
            ended = faintfield("verify", planes)
            assert ended.returncode == 1
            assert f"problem: {path}: was altered" in ended.stderr
            assert "ResultDamaged" in ended.stderr
            path.unlink()
            assert f"{path}: is missing" in faintfield("verify", planes / "reconstruction.json").stderr
            path.write_bytes(whole)
        assert faintfield("verify", planes).returncode == 0

    @pytest.mark.parametrize("name", ["reconstruction.json", "overview.json"])
    def test_every_value_of_the_other_records_is_vouched_for(self, name: str, planes: Path) -> None:
        path = planes / name
        whole = path.read_bytes()
        for way in list(_leaves(json.loads(whole)))[::20]:
            _altered(path, way)
            with pytest.raises(ResultDamaged):
                verify(path)
            path.write_bytes(whole)

    def test_a_record_that_is_gone_or_lost_its_digest_is_missed(self, planes: Path) -> None:
        path = planes / "plane_00500.0.json"
        write_by_hand(path, json.loads(path.read_bytes()))
        assert any("plane_00500.0.json, which it repeats, is missing" in problem for problem in _problems(planes))
        path.unlink()
        assert any("plane_00500.0.json, which it repeats, is missing" in problem for problem in _problems(planes))

    def test_inputs_are_compared_where_they_are(self, planes: Path, faintfield: Command, tmp_path: Path) -> None:
        view = planes.with_name("scene") / "view_r0_c0.tiff"
        view.write_bytes(view.read_bytes() + b"\0")
        ended = faintfield("verify", planes)
        assert ended.returncode == 1
        assert "view_r0_c0.tiff was altered since it was made from it" in ended.stderr
        scene = Path(shutil.move(planes.with_name("scene"), tmp_path / "deep" / "below"))
        ended = faintfield("verify", planes)
        assert ended.returncode == 0
        assert "not checked: " in ended.stderr
        assert "not found; name their folder by --inputs" in ended.stderr
        assert faintfield("verify", planes, "--inputs", scene).returncode == 1
        assert "no such folder" in faintfield("verify", planes, "--inputs", tmp_path / "absent").stderr

    def test_hostile_inputs_are_not_touched(self, planes: Path) -> None:
        path = planes / "plane_00500.0.json"
        content = json.loads(path.read_bytes())
        content["inputs"] |= {"/dev/zero": "0", "../planes/plane_00500.0.tiff": "0"}
        del content[DIGEST_KEY]
        path.write_bytes(with_digest(json.dumps(content).encode()))
        with pytest.raises(ResultDamaged):
            verify(planes)


def test_a_digest_is_of_the_text_without_white_space() -> None:
    content = with_digest(b'{"a": 1.0, "b": {"c": "x  y"}}')
    assert digest_holds(content) is True
    assert digest_holds(json.dumps(json.loads(content)).encode()) is True
    assert digest_holds(content.replace(b"1.0", b"1.00")) is False
    assert digest_holds(content.replace(b"x  y", b"x y")) is False
    assert digest_holds(content.rstrip()[:-1] + b', "later": 1}') is False
    assert digest_holds(b'{"a": 1.0}') is None


def test_of_two_sets_that_are_described_alike_the_one_with_the_same_images_is_meant(
    planes: Path, done: Command
) -> None:
    other = shutil.copytree(planes.parent / "scene", planes.parent / "another", symlinks=True)
    shutil.copyfile(other / "view_r0_c1.tiff", other / "view_r0_c0.tiff")
    assert "from another" not in done("verify", planes).stderr
    shutil.rmtree(planes.parent / "scene")
    with pytest.raises(ResultDamaged, match=r"view_r0_c0\.tiff .* since it was made from it"):
        verify(planes)


@pytest.mark.parametrize("file", ["/dev/zero", "../scene/view_r0_c0.tiff"])
def test_files_outside_the_folder_are_not_read(file: str, planes: Path) -> None:
    path = planes / "plane_00500.0.json"
    content = json.loads(path.read_bytes())
    content["sha256"] = {file: "0" * 64}
    del content[DIGEST_KEY]
    path.write_bytes(with_digest(json.dumps(content).encode()))
    assert any("plane_00500.0.json" in problem for problem in _problems(planes))
