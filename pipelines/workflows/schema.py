"""JSON Schemas of the files that are read and written, from the types that read and write them: `faintfield schema`."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
from msgspec import Struct
from msgspec import inspect as types

from faintfield.pipelines.arguments import SchemaKind
from faintfield.pipelines.formats.key_meanings import SECTION, key_meanings
from faintfield.pipelines.formats.plane_poses import PlanePoses
from faintfield.pipelines.formats.provenance import DIGEST_KEY
from faintfield.pipelines.formats.results.alignment import AlignmentRecord
from faintfield.pipelines.formats.results.figures import Metrics, Overview
from faintfield.pipelines.formats.results.geometry import GeometryRecord
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.records import DepthMapFileRecord, PlaneFileRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord
from faintfield.pipelines.formats.sets.board_set import BoardSetFile
from faintfield.pipelines.formats.sets.elemental_file import ElementalSetFile
from faintfield.pipelines.formats.sets.ground_truth import TrueDepth, Truth
from faintfield.pipelines.formats.sets.noise_set import NoiseSet
from faintfield.pipelines.formats.units import StatedUnits, named_by
from faintfield.pipelines.reconstruction.accuracy import DepthErrors
from faintfield.rig.cameras.settings import BUILT_IN_BACKENDS
from faintfield.rig.lights.settings import BUILT_IN_DRIVERS
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.protocol import WITHOUT_OPTIONS

_DIALECT = "https://json-schema.org/draft/2020-12/schema"

_INPUTS: dict[SchemaKind, tuple[type[Struct], str]] = {
    "rig": (RigSettings, "`rig.toml`: the rig and the capture, as `faintfield init` writes it."),
    "elemental": (ElementalSetFile, "`elemental.toml`: views with lens, poses and noise, ready to be reconstructed."),
    "boards": (BoardSetFile, "`charuco.toml`: images of boards, by node, for `faintfield geometry`."),
    "noise-frames": (NoiseSet, "`noise.toml`: dark and flat frames for `faintfield noise`."),
    "plane-poses": (PlanePoses, "TOML file of `--plane-pose`: planes at any place and angle."),
    "truth": (Truth, "`truth.json`: scene and poses of a simulated set."),
    "true-depth": (TrueDepth, "`true_depth.json`: depth of each pixel of an imported set."),
    "plan": (FrozenPlan, "`plan.json` of a session: the plan of a capture and the rig that it was made for."),
}

_RESULTS: dict[SchemaKind, tuple[type[Struct], str]] = {
    "noise": (NoiseRecord, "`noise.json`: the measured sensor."),
    "geometry": (GeometryRecord, "`geometry.json`: lens and poses from boards, and how well they are known."),
    "alignment": (AlignmentRecord, "`geometry.json` of `faintfield align`: poses by the views."),
    "reconstruction": (ReconstructionRecord, "`reconstruction.json`: all planes of one method."),
    "plane": (PlaneFileRecord, "`plane_00500.0.json` and the like: one plane."),
    "depth-map": (DepthMapFileRecord, "`depth_map.json`: the depth map of a sweep."),
    "surface": (SurfaceFileRecord, "`surface.json`: a picture sharp everywhere, with its depth."),
    "overview": (Overview, "`overview.json`: a set at a glance."),
    "metrics": (Metrics, "`metrics.json`: errors of planes where the truth is known."),
    "depth-errors": (DepthErrors, "`depth_errors.json`: errors of depths where the truth is known."),
}

_KINDS = _INPUTS | _RESULTS

# The digest that every record of a result ends with; earlier versions wrote none.
_DIGEST = {
    DIGEST_KEY: {
        "type": "string",
        "pattern": "^[0-9a-f]{64}$",
        "description": "SHA-256 of the other keys, by which `faintfield verify` finds changes.",
    }
}


class JsonSchema(Struct, frozen=True):
    """The result of `faintfield schema KIND`."""

    dialect: str = msgspec.field(name="$schema")
    title: str
    description: str
    reference: str = msgspec.field(name="$ref")
    definitions: dict[str, Any] = msgspec.field(name="$defs")

    @property
    def report(self) -> str:
        """The schema as indented JSON."""
        return json.dumps(msgspec.to_builtins(self), indent=2, ensure_ascii=False)


class KindList(Struct, frozen=True):
    """The result of `faintfield schema`: what each kind is, by its name."""

    kinds: dict[str, str]

    @property
    def report(self) -> str:
        """A line for each kind."""
        width = max(map(len, self.kinds))
        return "\n".join(f"{name:{width}}  {sentence}" for name, sentence in self.kinds.items())


def list_kinds() -> KindList:
    """Return all kinds of files."""
    return KindList({name: sentence for name, (_, sentence) in _KINDS.items()})


def describe_kind(kind: SchemaKind, units: StatedUnits) -> JsonSchema:
    """Return the schema of a kind of file; a result that states units has its keys named by them."""
    record, sentence = _KINDS[kind]
    content = msgspec.json.encode(msgspec.json.schema(record, schema_hook=_any_value))
    schema = msgspec.json.decode(content.replace(rb"\\Z", b"$"))  # as JSON Schema writes the end of a text
    # msgspec names a definition in full where two types share a name
    records = {
        name: part
        for part in records_of(types.type_info(record))
        for name in (part.cls.__name__, f"{part.cls.__module__}.{part.cls.__qualname__}")
    }
    definitions = {
        name: _with_meanings(part, records.get(name) or records.get(part["title"].partition("[")[0]))
        for name, part in schema["$defs"].items()
    }
    if "units" in record.__struct_fields__:
        definitions = {name: _in_units(part, units) for name, part in definitions.items()}
    if kind in _RESULTS:
        root = definitions[record.__name__]
        definitions[record.__name__] = {**root, "properties": root["properties"] | _DIGEST}
    if record is RigSettings:
        definitions = {name: _as_written(part) for name, part in definitions.items()}
    return JsonSchema(_DIALECT, kind, sentence, schema["$ref"], definitions)


def _any_value(_: type) -> dict[str, Any]:
    """Return the schema of `object`, the only type of a field that msgspec has none for."""
    return {"description": "Any value."}


def records_of(part: object) -> Iterator[types.StructType | types.DataclassType]:
    """Yield the records in the description of a type, or of several, as msgspec has it."""
    if isinstance(part, types.StructType | types.DataclassType):
        yield part
        part = [field.type for field in part.fields]
    elif isinstance(part, types.Type):
        part = msgspec.structs.astuple(part)
    for inner in part if isinstance(part, list | tuple) else ():
        yield from records_of(inner)


def _with_meanings(
    definition: Mapping[str, Any], record: types.StructType | types.DataclassType | None
) -> dict[str, Any]:
    """Return a definition without the sections of a docstring, and that of a record with the meanings of its keys."""
    definition = dict(definition)
    if "description" in definition:
        definition["description"] = SECTION.sub("", definition["description"])
    if record is None:
        return definition
    meanings = key_meanings(record.cls)
    properties = {name: dict(part) for name, part in definition["properties"].items()}
    for field in record.fields:
        if field.name in meanings:
            properties[field.encode_name]["description"] = meanings[field.name]
    if isinstance(record, types.StructType) and record.tag_field:
        properties[record.tag_field]["description"] = "Kind of this table, which decides about its other keys."
    return {**definition, "properties": properties}


def _in_units(definition: Mapping[str, Any], units: StatedUnits) -> dict[str, Any]:
    """Return a definition with the keys that a file in these units has."""
    if "properties" not in definition:
        return dict(definition)
    required = named_by(dict.fromkeys(definition.get("required", [])), units)
    return {**definition, "properties": named_by(definition["properties"], units), "required": list(required)}


def _as_written(definition: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of rig.toml as it is written: the options of a plug-in stand among the other keys."""
    properties = dict(definition.get("properties", {}))
    if properties.pop("options", None) is None:
        return dict(definition)
    for key, name, built_in in (("backend", "name", BUILT_IN_BACKENDS), ("driver", "plugin", BUILT_IN_DRIVERS)):
        if properties.get(key, {}).get("enum") == ["plugin"]:
            properties[key] = {**properties.pop(name), "type": "string", "not": {"enum": list(built_in)}}
    required = [key for key in definition["required"] if key in properties]
    written = {**definition, "properties": properties, "required": required, "additionalProperties": True}
    if "protocol" in properties:
        written["if"] = {"properties": {"protocol": {"enum": list(WITHOUT_OPTIONS)}}}
        written["then"] = {"propertyNames": {"enum": list(properties)}}
    return written
