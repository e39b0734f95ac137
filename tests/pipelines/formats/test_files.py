"""Files and folders appear whole or not at all."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from faintfield.pipelines.errors import CannotWrite, DiskFull, OutputBusy, OutputExists
from faintfield.pipelines.formats.files import (
    CACHE_FILE,
    Hashes,
    check_free,
    exclusive,
    removed_if_empty,
    require_room,
    sha256,
    write_json,
    write_whole,
    writing,
    writing_folder,
)


def _everything_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


class _Stop(BaseException):
    """An exception that no code expects."""


def test_file_is_written_alone(tmp_path: Path) -> None:
    for content in ("words – with a dash\n", b"\0\xff bytes"):
        write_whole(tmp_path / "new" / "file", content)
        expected = content.encode() if isinstance(content, str) else content
        assert (tmp_path / "new" / "file").read_bytes() == expected
        assert _everything_below(tmp_path) == {"new", "new/file"}


def test_new_files_have_the_permissions_of_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_json(tmp_path / "file", [1])
        with writing_folder(tmp_path / "folder"):
            pass
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o750


def test_file_is_named_once_it_is_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []

    def watched[**P, R](name: str, step: Callable[P, R]) -> Callable[P, R]:
        def take(*given: P.args, **named: P.kwargs) -> R:
            steps.append(name)
            return step(*given, **named)

        return take

    for name in ("fsync", "replace"):
        monkeypatch.setattr(os, name, watched(name, getattr(os, name)))
    write_whole(tmp_path / "file", b"content")
    assert steps == ["fsync", "replace", "fsync"]  # the content, its name, and the folder's entry


def test_interrupted_write_keeps_earlier_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("before")

    def stop_half_way() -> None:
        with writing(path) as file:
            file.write(b"half of")
            file.flush()
            raise _Stop

    with pytest.raises(_Stop):
        stop_half_way()
    assert path.read_text() == "before"
    assert _everything_below(tmp_path) == {"file"}


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("stops", [False, True])
def test_folder_is_replaced_whole_or_not(exists: bool, stops: bool, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if exists:
        (out / "deep").mkdir(parents=True)
        (out / "deep" / "old").touch()
        (out / "mark").touch()
    before = _everything_below(tmp_path)
    with contextlib.suppress(_Stop), writing_folder(out, replace_if="mark") as folder:
        (folder / "new").touch()
        assert out.exists() == exists
        if stops:
            raise _Stop
    assert _everything_below(tmp_path) == (before if stops else {"out", "out/new"})


def _with_a_file(out: Path) -> None:
    out.mkdir()
    (out / "theirs").touch()


@pytest.mark.parametrize(
    ("prepare", "earlier", "words"),
    [
        (_with_a_file, {}, r"holds files already \(theirs\)"),
        (_with_a_file, {"replace_only": ["ours*", "t"]}, "holds files already"),
        (Path.touch, {"replace_if": "elemental.toml"}, "is a file"),
    ],
)
def test_foreign_files_are_left_alone(
    prepare: Callable[[Path], object], earlier: dict[str, Any], words: str, tmp_path: Path
) -> None:
    prepare(tmp_path / "out")
    before = _everything_below(tmp_path)
    with pytest.raises(OutputExists, match=words), writing_folder(tmp_path / "out", **earlier):
        pytest.fail("nothing must be built")
    assert _everything_below(tmp_path) == before


def test_refused_folder_is_named_as_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _with_a_file(Path("out"))
    with pytest.raises(OutputExists, match=r"^out: holds files"):
        check_free(Path("out"))


def test_folder_of_inputs_is_never_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "deep").mkdir(parents=True)
    (out / "mark").touch()
    (out / "link").symlink_to(tmp_path / "elsewhere")
    before = _everything_below(tmp_path)
    for read in (out, out / "deep", out / "deep" / ".." / ".." / "out", out / "link"):
        expected = pytest.raises(OutputExists, match="which is read")
        with expected, writing_folder(out, replace_if="mark", reads=[read]):
            pytest.fail("nothing must be built")
    assert _everything_below(tmp_path) == before


def test_folder_of_replaceable_names_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("cameras.txt", "a.model", "b.model"):
        (out / name).touch()
    with writing_folder(out, replace_only=["*.model", "cameras.txt"]) as folder:
        (folder / "c.model").touch()
    assert _everything_below(tmp_path) == {"out", "out/c.model"}


@pytest.mark.parametrize("write", [lambda path: write_whole(path, b""), lambda path: writing_folder(path).__enter__()])
def test_impossible_place_is_named(write: Callable[[Path], object], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CannotWrite, match=r"file.*; name a place that can be written") as refused:
        write(tmp_path / "file" / "out")
    assert not isinstance(refused.value, DiskFull)


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"file": 3}', None])
def test_unreadable_cache_of_hashes_is_ignored(content: bytes | None, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"abc")
    if content is None:
        os.mkfifo(tmp_path / CACHE_FILE)
    else:
        (tmp_path / CACHE_FILE).write_bytes(content)
    assert Hashes(tmp_path).of("file") == sha256(tmp_path / "file")


def test_room_is_asked_for_before_work(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    require_room(tmp_path / "not" / "yet" / "there", 1, written_bytes=1)
    assert capfd.readouterr().err == ""
    require_room(tmp_path, 1, written_bytes=1_400_000_000)
    assert capfd.readouterr().err.endswith(": about 1.4 GB will be written\n")
    with pytest.raises(DiskFull, match=r"there: 1000000000000\.0 MB are needed, .* MB are free; make room"):
        require_room(tmp_path / "not" / "yet" / "there", 10**18)


def test_second_writer_of_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with exclusive(folder):
        with pytest.raises(OutputBusy, match="another faintfield command is writing there"), exclusive(folder):
            pass
        assert folder.is_dir()
    assert not folder.exists()  # nothing was put into it
    with exclusive(folder):
        (folder / "plane.tiff").touch()
    assert [path.name for path in folder.iterdir()] == ["plane.tiff"]


def test_interrupt_after_opening_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = Path.open

    def interrupted(self: Path, *arguments: Any) -> None:
        opened(self, *arguments).close()
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "plane.json", "{}")
    assert list(tmp_path.iterdir()) == []


def test_only_new_empty_folders_are_removed(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    for folder in (kept, tmp_path / "made", tmp_path / "filled"):
        with removed_if_empty(folder):
            folder.mkdir(exist_ok=True)
            if folder.name == "filled":
                (folder / "file").touch()
    assert _everything_below(tmp_path) == {"kept", "filled", "filled/file"}
