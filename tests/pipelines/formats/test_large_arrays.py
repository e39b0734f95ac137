"""Arrays that memory has no room for: when they go to a file, that none stays behind, and that memory stays free."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from shutil import disk_usage
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.errors import DiskFull
from faintfield.pipelines.formats import large_arrays
from faintfield.pipelines.formats.large_arrays import available_bytes, maps_in_files, memory_or_file
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from tests.pipelines.conftest import SetMaker

# Back-projects a set with little more memory than the process has; argument 4 says what the system claims to have free.
_LIMITED = """
import re, resource, sys
from pathlib import Path
from faintfield.pipelines.formats import large_arrays
from faintfield.pipelines.pages import report
from faintfield.pipelines.reconstruction import overview
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.workflows.reconstruct import reconstruct_and_report
from faintfield.pipelines.reconstruction.request import Request
elemental_set, warm = load_set(Path(sys.argv[1])), load_set(Path(sys.argv[1]).with_name("warm"))
out, request = Path(sys.argv[2]), Request([500.0], ["backprojection"])
reconstruct_and_report(warm, out.with_name("warm-out"), request)
large_arrays.available_bytes = lambda: int(sys.argv[4])
used = int(re.search(r"VmData:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (used + int(sys.argv[3]),) * 2)
reconstruct_and_report(elemental_set, out, request)
"""


def test_limit_of_control_group_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = tmp_path / "groups" / "slurm" / "job"
    (tmp_path / "self").mkdir()
    job.mkdir(parents=True)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=8000 * 1024))
    (tmp_path / "self" / "cgroup").write_text("0::/slurm/job\n")
    (job.parent / "memory.stat").write_text("anon 1000000\nfile 2500000\n")
    monkeypatch.setattr(large_arrays, "_PROC", tmp_path)
    monkeypatch.setattr(large_arrays, "_CGROUPS", tmp_path / "groups")
    for limit, expected in (("4000000\n", 4000000 - 1000000), ("max\n", 8000 * 1024)):
        (job.parent / "memory.max").write_text(limit)
        assert available_bytes() == expected


def test_large_arrays_are_in_nameless_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "available_bytes", lambda: 8000)
    allocate = memory_or_file(tmp_path / "out")
    small = allocate((10, 100), np.float32)
    assert small.flags.owndata
    assert not (tmp_path / "out").exists()
    large = allocate((10, 101), np.float32)
    large[:] = np.arange(1010).reshape(10, 101)
    assert not large.flags.owndata
    assert large.dtype == np.float32
    np.testing.assert_array_equal(large.sum(dtype=float), 1009 * 505)
    assert not list((tmp_path / "out").iterdir())


def test_full_disk_is_named_or_avoided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(large_arrays, "available_bytes", lambda: 0)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DiskFull, match="no space left"):
        memory_or_file(tmp_path)((10, 10), np.float32)
    assert resource.getrlimit(resource.RLIMIT_FSIZE) == before
    assert maps_in_files(tmp_path)((1000, 1000), np.float32).base is None


def test_channel_in_files_equals_that_in_memory(make_set: SetMaker, tmp_path: Path) -> None:
    images = np.random.default_rng(20110919).integers(100, 2000, (3, 12, 16)).astype(np.uint16)
    images[1, 3, 4] = 65535
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "saturation_dn": 60000.0}
    elemental_set = load_set(make_set(list(images), noise=noise))
    (layout,) = channel_layouts(elemental_set)
    in_memory = load_channel(elemental_set, layout)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(large_arrays, "available_bytes", lambda: 0)
        in_files = load_channel(elemental_set, layout, memory_or_file(tmp_path))
    assert not in_files.electrons.flags.owndata
    np.testing.assert_array_equal(in_files.electrons, in_memory.electrons)
    assert in_files.valid is not None
    assert np.argwhere(~in_files.valid).tolist() == [[1, 3, 4]]


@pytest.mark.deep
@pytest.mark.parametrize(("free_bytes", "succeeds"), [(1 << 20, True), (1 << 40, False)])
def test_set_larger_than_memory_is_reconstructed(
    free_bytes: int, succeeds: bool, make_set: SetMaker, tmp_path: Path
) -> None:
    """80 MB of electrons where 40 MB may be taken: by memory map they are done, in memory they cannot be."""
    rng = np.random.default_rng(20110919)
    frame = rng.integers(100, 2000, (500, 400)).astype(np.uint16)
    make_set([frame[:100, :100]] * 4, name="warm")
    folder = make_set([frame] * 100, name="large")
    assert tifffile.imread(folder / "view_99.tiff").size * 4 * 100 == 80_000_000
    words = [folder, tmp_path / "out", 40_000_000, free_bytes]
    ended = subprocess.run(
        [sys.executable, "-c", _LIMITED, *map(str, words)], capture_output=True, check=False, text=True
    )
    assert (ended.returncode == 0) == succeeds, ended.stderr
    assert ("MemoryError" in ended.stderr) == (not succeeds)
    assert (tmp_path / "out" / "plane_00500.0.tiff").is_file() == succeeds


def test_maps_in_files_leave_half_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used, usage = 0, disk_usage(tmp_path)
    monkeypatch.setattr(large_arrays, "disk_usage", lambda _: usage._replace(free=20_000_000 - used))
    allocate = maps_in_files(tmp_path)
    for expected in (True, True, False):
        array = allocate((1000, 1000), np.float32)
        array[:] = 1.0
        assert isinstance(array.base, np.memmap) is expected
        used += array.nbytes if expected else 0
    assert not isinstance(allocate((10, 10), np.float32).base, np.memmap)
    assert [*tmp_path.iterdir()] == []  # files have no names
