"""Verify results: each record against its digest, the files that it vouches for, and the inputs that it was made from.

Nothing is changed. Inputs are compared where they are found; a verdict says which were not.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import msgspec
from msgspec import Struct

from faintfield.pipelines.errors import InputError, MissingFile
from faintfield.pipelines.formats.files import files_below, problem_of_file, sha256
from faintfield.pipelines.formats.provenance import digest_holds
from faintfield.pipelines.formats.reading import JSON_FAILURES, read_content
from faintfield.pipelines.formats.results.alignment import AlignmentRecord
from faintfield.pipelines.formats.results.figures import METRICS_FILE, OVERVIEW_FILE, Metrics, Overview
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, CameraPoses, GeometryRecord
from faintfield.pipelines.formats.results.noise import NOISE_FILE, NoiseRecord
from faintfield.pipelines.formats.results.records import (
    DEPTH_MAP_FILE,
    RECONSTRUCTION_FILE,
    DepthMapFileRecord,
    PlaneFileRecord,
    ReconstructionRecord,
    record_name,
)
from faintfield.pipelines.formats.results.surface import SURFACE_FILE, SurfaceFileRecord, read_result
from faintfield.pipelines.formats.units import record_of

# The type of each record, by a pattern of its name; of geometry.json, a person may write the poses alone.
_KINDS: dict[str, tuple[type[Struct], ...]] = {
    RECONSTRUCTION_FILE: (ReconstructionRecord,),
    "plane_*.json": (PlaneFileRecord,),
    DEPTH_MAP_FILE: (DepthMapFileRecord,),
    SURFACE_FILE: (SurfaceFileRecord,),
    OVERVIEW_FILE: (Overview,),
    METRICS_FILE: (Metrics,),
    NOISE_FILE: (NoiseRecord,),
    GEOMETRY_FILE: (GeometryRecord, AlignmentRecord, CameraPoses),
}

# How far above a result its inputs are searched for: a method's folder lies in `reconstructions`, this in the session.
_LEVELS_ABOVE = 2


class ResultVerdict(Struct, frozen=True):
    """Counts of records, of files beside them and of inputs that were compared; problems, and what was not checked."""

    records: int
    files: int
    inputs: int
    problems: tuple[str, ...]
    unchecked: tuple[str, ...]


@dataclass(frozen=True)
class _Named:
    """A file that a record names by its SHA-256; it must lie in `folder`."""

    record: Path
    folder: Path
    name: str
    sha256: str
    is_input: bool


# Returns the folder that the inputs of a record lie in, given its path and their SHA-256 by name; None if not found.
type FindInputs = Callable[[Path, Mapping[str, str]], Path | None]


def is_record(path: Path) -> bool:
    """Return whether a file has the name of a record that can be verified."""
    return any(fnmatchcase(path.name, pattern) for pattern in _KINDS)


def records_below(folder: Path) -> list[Path]:
    """Return the records in a folder and below it, in order."""
    return sorted({path for pattern in _KINDS for path in files_below(folder, pattern)})


def records_of(path: Path) -> list[Path]:
    """Return the records that belong to a result: all below a folder, and those that a reconstruction.json repeats."""
    if path.is_dir():
        found = records_below(path)
        if not found:
            raise MissingFile(
                f"{path}: holds no session and no result; name the folder of one, and that of a set by --inputs"
            )
        return found
    if not path.is_file() or not is_record(path):
        raise MissingFile(
            f"{path}: is not there, or is no record of a result ({', '.join(_KINDS)}); name one of these, or its folder"
        )
    if path.name != RECONSTRUCTION_FILE:
        return [path]
    try:
        repeated = _repeated(read_result(path, ReconstructionRecord))
    except InputError:
        return [path]
    return [path, *(own for name in repeated if (own := path.with_name(name)).is_file())]


def verify_results(
    records: Sequence[Path],
    find_inputs: FindInputs | None = None,
    progress: Callable[[Sequence[Path]], Iterable[Path]] = iter,
    hashed: Callable[[Path], str] = sha256,
) -> ResultVerdict:
    """Verify records, and with `find_inputs` their inputs, too.

    `progress` wraps the iteration over the files that are hashed; `hashed` returns the SHA-256 of a file.
    """
    work = _Verification()
    for path in records:
        work.read(path)
    for path, record in work.content.items():
        if isinstance(record, ReconstructionRecord):
            work.compare_repeated(path, record)
    if find_inputs is not None:
        work.look_for_inputs(find_inputs)
    named = [*work.named.values()]
    for file, path in zip(named, progress([file.folder / file.name for file in named]), strict=True):
        if fault := problem_of_file(path, file.folder, file.sha256, hashed):
            work.problems.append(
                f"{file.record}: {path} {fault} since it was made from it, or is another input of that name"
                if file.is_input
                else f"{path}: {fault}"
            )
    inputs = sum(file.is_input for file in named)
    found = (len(work.content), len(named) - inputs, inputs)
    return ResultVerdict(*found, tuple(work.problems), tuple(work.unchecked))


class _Verification:
    """A verification under way: what was read, what is to be hashed, and what was found."""

    def __init__(self) -> None:
        self.content: dict[Path, Struct] = {}
        self.named: dict[tuple[Path, str], _Named] = {}  # each file is compared once, though many records name it
        self.problems: list[str] = []
        self.unchecked: list[str] = []
        self._vouching: set[Path] = set()

    def read(self, path: Path) -> None:
        """Read a record, compare it with its digest, and note the files beside it."""
        try:
            text = read_content(path)
            self.content[path] = record = _decoded(path, text)
            holds = digest_holds(text)
        except MissingFile as failure:
            self.problems.append(f"{path}: cannot be read ({failure.__cause__})")
            return
        except JSON_FAILURES as failure:
            self.problems.append(f"{path}: is damaged ({failure})")
            return
        if holds:
            self._vouching.add(path)
        elif holds is None:
            self.unchecked.append(f"{path}: has no digest: an earlier version wrote it, or a person")
        else:
            self.problems.append(f"{path}: was altered after it was written")
        hashes = _sidecar_hashes(record)
        self._name(path, path.parent, hashes, is_input=False)
        if isinstance(record, PlaneFileRecord | DepthMapFileRecord | SurfaceFileRecord):
            self.problems += [f"{path}: has no SHA-256 of {name}" for name in record.files if name not in hashes]

    def compare_repeated(self, path: Path, record: ReconstructionRecord) -> None:
        """Compare a reconstruction.json with the records of its planes and of its depth map, which it repeats."""
        for name, part in _repeated(record).items():
            own = path.with_name(name)
            says = self.content.get(own)
            said = says.planes if isinstance(says, PlaneFileRecord) else getattr(says, "depth_map", None)
            if says is not None and msgspec.json.encode(said) != msgspec.json.encode(part):
                self.problems.append(f"{path}: does not say what {own.name} says")
            elif path in self._vouching and own not in self._vouching:
                self.problems.append(f"{path}: {own.name}, which it repeats, is missing, damaged, or has no digest")
            elif says is None:
                self.unchecked.append(f"{path}: {own.name}, which it repeats, is missing or damaged")

    def look_for_inputs(self, find: FindInputs) -> None:
        """Note the inputs of every record that are found, and name the others."""
        folders: dict[tuple[object, ...], Path | None] = {}
        for path, record in self.content.items():
            made = record.provenance if isinstance(record, NoiseRecord) else record
            inputs: Mapping[str, str] = getattr(made, "inputs", {})
            if not inputs:
                continue
            key = (path.parent, *next(iter(inputs.items())))
            if key not in folders:
                folders[key] = find(path, inputs)
            folder = folders[key]
            there = {name: known for name, known in inputs.items() if folder and _exists(folder / name)}
            if folder:
                self._name(path, folder, there, is_input=True)
            if absent := [name for name in inputs if name not in there]:
                more = f" and {len(absent) - 1} other inputs" if len(absent) > 1 else ""
                self.unchecked.append(f"{path}: {absent[0]}{more} not found; name their folder by --inputs")

    def _name(self, record: Path, folder: Path, sha256_by_name: Mapping[str, str], *, is_input: bool) -> None:
        for name, known in sha256_by_name.items():
            self.named.setdefault((folder / name, known), _Named(record, folder, name, known, is_input))


def inputs_in(folder: Path) -> FindInputs:
    """Return a function that says that all inputs are in one folder."""
    return lambda _, __: folder.resolve()


def inputs_around(record: Path, inputs: Mapping[str, str]) -> Path | None:
    """Return the folder of a record's inputs: its own, one around it, or one beside it that holds the very same file.

    The first input is the file that describes the others, such as elemental.toml or the plan of a session.
    """
    described_in = next(iter(inputs))
    folder = record.parent.resolve()
    around = [folder, *folder.parents[:_LEVELS_ABOVE]]
    for candidate in around:
        if _exists(candidate / described_in):
            return candidate
    beside: list[Path] = []
    with suppress(OSError):  # a folder around it that may not be listed
        beside = [place for level in around[1:] for place in sorted(level.iterdir()) if place.is_dir()]
    # Several sets may be described alike: the one whose files are the same, too, is meant
    for name, digest in inputs.items():
        same = [place for place in beside if problem_of_file(place / name, place, digest) is None]
        beside = same or ([] if name == described_in else beside)
        if len(beside) < 2:
            break
    return beside[0] if beside else None


def _decoded(path: Path, text: bytes) -> Struct:
    *others, last = next(kinds for pattern, kinds in _KINDS.items() if fnmatchcase(path.name, pattern))
    for kind in others:
        with suppress(msgspec.ValidationError):
            return record_of(text, kind)
    return record_of(text, last)


def _sidecar_hashes(record: Struct) -> Mapping[str, str]:
    if isinstance(record, NoiseRecord):
        return {record.maps: record.maps_sha256} if record.maps_sha256 else {}
    hashes: Mapping[str, str] = getattr(record, "sha256", {}) or {}  # it may be UNSET
    return hashes


def _repeated(record: ReconstructionRecord) -> dict[str, object]:
    """Return the parts of a reconstruction.json that records beside it hold, too, by the names of these."""
    parts: dict[str, object] = {}
    for file in dict.fromkeys(plane.file for plane in record.planes):
        parts[record_name(file)] = [plane for plane in record.planes if plane.file == file]
    return parts if record.depth_map is None else parts | {DEPTH_MAP_FILE: record.depth_map}


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
