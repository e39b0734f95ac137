"""`faintfield schema`: by the schemas, jsonschema accepts what the program writes and refuses what is damaged."""

import io
import json
import re
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from faintfield.pipelines.arguments import SchemaKind
from faintfield.pipelines.formats.results.records import PlaneFileRecord
from faintfield.pipelines.formats.units import StatedUnits, json_of
from tests.pipelines.conftest import Command, run_undrawn
from tests.pipelines.forms import GOLDEN

jsonschema = pytest.importorskip("jsonschema")


@cache
def _validator(words: str) -> Any:
    """Return the validator by the schema of a kind, which must be sound itself; options may follow the kind."""
    printed = io.BytesIO()
    with redirect_stdout(io.TextIOWrapper(printed, write_through=True)) as terminal:
        run_undrawn("schema", *words.split())
        terminal.flush()
    schema = json.loads(printed.getvalue())
    validator = jsonschema.validators.validator_for(schema)
    validator.check_schema(schema)
    return validator(schema)


def _valid(words: str, content: Any) -> bool:
    return bool(_validator(words).is_valid(content))


def _damaged(content: dict[str, Any], required: str) -> Iterator[dict[str, Any]]:
    """Yield the content without a key, and with that of a wrong type."""
    yield {key: value for key, value in content.items() if key != required}
    yield content | {required: -1.5}


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.json")), ids=lambda path: path.stem)
def test_golden_records_are_valid_and_damaged_ones_not(path: Path) -> None:
    kinds: tuple[str, ...] = get_args(SchemaKind.__value__)
    kind = max((kind for kind in kinds if path.stem.startswith(kind.replace("-", "_"))), key=len)
    content = json.loads(path.read_bytes())
    assert _valid(kind, content)
    key = {"metrics": "planes", "noise": "read_noise_e", "overview": "brightness", "geometry": "lens"}.get(kind)
    assert not any(_valid(kind, damaged) for damaged in _damaged(content, key or "versions"))


def test_records_are_valid_in_their_units_only() -> None:
    record = msgspec.json.decode((GOLDEN / "plane_pmlem.json").read_bytes(), type=PlaneFileRecord)
    units = StatedUnits("disparity_px", "relative")
    content = json.loads(json_of(msgspec.structs.replace(record, units=units)))
    assert _valid("plane --depth-unit disparity_px --light-unit relative", content)
    assert not _valid("plane", content)


def test_digest_ends_records_of_results_only() -> None:
    errors = dict.fromkeys(("share", "median_error_mm", "median_relative_error", "within_2_percent"), 0.5) | {
        "file": "depth_mm.tiff",
        "samples": 3,
    }
    assert _valid("depth-errors", errors | {"record_sha256": "0" * 64})
    assert not _valid("depth-errors", errors | {"record_sha256": "0" * 63})
    assert not _valid("depth-errors", errors | {"digest": "0" * 64})


def test_tables_of_toml_are_valid(simulated_scene: Path, tmp_path: Path, done: Command) -> None:
    done("init", tmp_path / "rig.toml")
    for kind, path, key in (
        ("rig", tmp_path / "rig.toml", "camera"),
        ("elemental", simulated_scene / "elemental.toml", "view"),
    ):
        content = tomllib.loads(path.read_text())
        assert _valid(kind, content)
        assert not any(_valid(kind, damaged) for damaged in (*_damaged(content, key), content | {"veiw": []}))
    rig = tomllib.loads((tmp_path / "rig.toml").read_text())
    stage = {"protocol": "micromanager", "device": "XY"}
    assert _valid("rig", rig | {"stage": stage})
    assert not _valid("rig", rig | {"stage": stage | {"protocol": "grbl", "port": "/dev/ttyUSB0"}})
    assert _valid("truth", json.loads((simulated_scene / "truth.json").read_bytes()))
    documents = Path(__file__).parents[3] / "docs"
    for kind, name in (("boards", "how-to/measure_geometry.md"), ("plane-poses", "how-to/tilt_planes.md")):
        (example,) = re.findall(r"```toml\n(format = 1\n.*?)```", (documents / name).read_text(), re.DOTALL)
        assert _valid(kind, tomllib.loads(example))
        assert not _valid(kind, tomllib.loads(example.replace("name =", "nam =")))


def test_files_of_a_session_are_valid(calibrated_session: Path) -> None:
    names = {"plan": "plan.json", "noise": "noise.json", "geometry": "geometry.json"}
    for kind, path in {
        **{kind: calibrated_session / name for kind, name in names.items()},
        "reconstruction": next(calibrated_session.rglob("reconstruction.json")),
        "plane": next(calibrated_session.rglob("plane_*.json")),
        "overview": next(calibrated_session.rglob("overview.json")),
    }.items():
        assert _valid(kind, json.loads(path.read_bytes())), path


def test_drivers_of_a_rig_are_described(tmp_path: Path, done: Command) -> None:
    """Plug-ins have any keys, built-in drivers only their own."""
    done("init", tmp_path / "rig.toml")
    rig = tomllib.loads((tmp_path / "rig.toml").read_text())
    assert _valid("rig", rig | {"camera": {"backend": "acme", "gain": 3}})
    assert not _valid("rig", rig | {"camera": {"backend": "simulated", "gain": 3}})
    assert _valid("rig", rig | {"light": [{"name": "lamp", "driver": "acme", "gain": 3}]})
    assert not _valid("rig", rig | {"light": [{"name": "lamp", "driver": "command", "gain": 3}]})


def test_kinds_are_listed_and_fields_explained(done: Command) -> None:
    lines = done("schema").stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(get_args(SchemaKind.__value__))
    stage = json.loads(done("--json", "schema", "rig").stdout)["$defs"]["StageSettings"]
    assert stage["properties"]["baud"]["description"] == "Bits per second."
    assert stage["description"] == "Connection and limits of the stage: the `[stage]` table of rig.toml."


@pytest.mark.parametrize("kind", get_args(SchemaKind.__value__))
def test_keys_have_meanings(kind: str, done: Command) -> None:
    definitions = json.loads(done("schema", kind).stdout)["$defs"]
    keys = [
        (name, key, part) for name, record in definitions.items() for key, part in record.get("properties", {}).items()
    ]
    assert [(name, key) for name, key, part in keys if not part.get("description")] == []
