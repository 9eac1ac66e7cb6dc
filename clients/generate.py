#!/usr/bin/env python3
"""Writes the message types of the Python client and of the viewer from protocol/schema, and the blocking Python client
from the one for asyncio.

    clients/generate.py          (writes them)
    clients/generate.py --check  (fails if one differs)
"""

from __future__ import annotations

import itertools
import json
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = ROOT / "protocol" / "schema"
PYTHON = "clients/python/src/wildcity/messages.py"
TYPESCRIPT = "clients/viewer/src/messages.ts"
ASYNCIO = "clients/python/src/wildcity/aio.py"
BLOCKING = "clients/python/src/wildcity/sync.py"

Schema = dict[str, Any]

# Names of the clients' types, where they are not those of the schemas.
RENAMED = {"RigCamera": "Camera", "Image": "ImageInfo", "Observation": "Metadata", "Many": "ManyMetadata"}
# Names of the answers by their type.
ANSWERS = {
    "welcome": "Welcome",
    "opened": "Opened",
    "resumed": "Resumed",
    "ok": "Ok",
    "shared_memory": "SharedMemoryOffer",
    "in_memory": "InMemory",
    "switched": "Switched",
    "closed": "Closed",
    "error": "Refusal",
}
# Objects without a name in the schema, by one of their fields.
UNNAMED = {"trajectory": "Station", "snapshot": "SnapshotPoint", "episode": "RecordedPoint"}
# The order of fields as positional arguments, which is part of the Python client's interface: the schemas sort optional
# fields by name. Fields that are not here follow, required ones first.
ORDER = {
    "AxisNoise": ["noise", "bias"],
    "Camera": [
        "name",
        "width",
        "height",
        "fx",
        "fy",
        "cx",
        "cy",
        "camera_to_rig",
        "lens",
        "windshield",
        "shutter",
        "exposure",
        "overlay",
        "native_size",
    ],
    "CameraSensor": ["drop", "late", "freeze", "noise", "exposure", "dirt"],
    "DriveSection": ["name", "from_m", "to_m", "every_m"],
    "Dynamics": ["model", "speed", "reverse"],
    "Exposure": ["matrix", "gain", "offset"],
    "Imu": ["accelerometer", "gyroscope", "bias_period_us"],
    "Lens": ["model", "k", "p", "s", "reference", "polynomial", "linear_cde", "max_angle"],
    "Outputs": [
        "cameras",
        "encoding",
        "quality",
        "depth",
        "opacity",
        "normals",
        "instances",
        "images",
        "frames",
        "trust",
    ],
    "RandomStart": ["trajectory", "from_m", "to_m", "lateral_m", "heading_rad"],
    "Repair": ["model", "below", "above", "at_least", "per_step", "on_failure"],
    "Sensors": ["cameras", "imu", "wheel_speed", "delay_us", "lidars"],
    "WheelSpeed": ["noise", "scale"],
}
# Defaults in Python other than None and those of the schema.
DEFAULTS = {
    ("Metadata", "history"): "()",
    ("Metadata", "events"): "()",
    ("Metadata", "sweeps"): "()",
    ("Opened", "lidars"): "()",
    ("ImageInfo", "back"): "0",
}
# Fields that Python always has to be given, although the server knows a default for some lenses.
REQUIRED = {("Camera", "fx"), ("Camera", "fy")}
# What Python takes for fields of `open` in place of the schema's type.
OPEN_TYPES = {"repair": "str | Repair", "profile": "Mapping[str, float | bool | None]"}
# Fields of `open` that the client fills in, or takes as an argument of its own.
OPEN_OWN = {"seq", "type", "twin"}
# Written by hand, in `pose.py` and `pose.ts`.
BY_HAND = {"Pose"}


def main() -> None:
    texts = {PYTHON: python(), TYPESCRIPT: typescript(), BLOCKING: blocking()}
    differ = [name for name, text in texts.items() if read(name) != text]
    if "--check" not in sys.argv[1:]:
        for name in differ:
            (ROOT / name).write_text(texts[name])
    elif differ:
        sys.exit(f"{', '.join(differ)}: not as generated; run clients/generate.py and commit the result")


def read(name: str) -> str:
    path = ROOT / name
    return path.read_text() if path.exists() else ""


class Types:
    """The types of the messages, by their name: those that others refer to come first."""

    def __init__(self) -> None:
        self.types: dict[str, Schema] = {}
        for file in ("request", "answer", "drive", "observation", "many"):
            self.add_file(file)

    def add_file(self, file: str) -> None:
        schema = json.loads((SCHEMAS / f"{file}.json").read_text())
        definitions = schema.get("$defs", {})
        if file == "request":
            for variant in schema["oneOf"]:
                if variant["properties"]["type"]["const"] == "open":
                    self.open = variant
                    self.references(variant, definitions)
                if variant["properties"]["type"]["const"] in ("step", "branch", "reset"):
                    self.references(variant, definitions)
        elif file == "answer":
            for variant in schema["oneOf"]:
                name = ANSWERS[variant["properties"].pop("type")["const"]]
                if "$ref" in variant:
                    self.references(variant, definitions)
                else:
                    self.add(name, variant, definitions)
        else:
            self.add(schema["title"], schema, definitions)

    def references(self, value: Any, definitions: Schema) -> None:
        """Adds every definition that a part of a schema refers to."""
        if isinstance(value, list):
            for item in value:
                self.references(item, definitions)
        elif isinstance(value, dict):
            if isinstance(value.get("$ref"), str):
                name = value["$ref"].rpartition("/")[2]
                self.add(name, definitions[name], definitions)
            for key, item in value.items():
                if key != "$defs":
                    self.references(item, definitions)

    def add(self, name: str, schema: Schema, definitions: Schema) -> None:
        known = renamed(name)
        if known in self.types:
            return
        for part in schema.get("anyOf", []):
            if "properties" in part and (unnamed := unnamed_object(part)):
                self.add(unnamed, part, definitions)
        self.references({key: item for key, item in schema.items() if key != "$defs"}, definitions)
        self.types.setdefault(known, schema)


def renamed(name: str) -> str:
    return RENAMED.get(name, name)


def unnamed_object(schema: Schema) -> str | None:
    return next((name for field, name in UNNAMED.items() if field in schema["properties"]), None)


def words(schema: Schema) -> list[str] | None:
    """The texts that a value may have, if it is one of some texts."""
    if "enum" in schema:
        return list(schema["enum"])
    if "const" in schema:
        return [schema["const"]]
    parts = schema.get("oneOf", [])
    found = [word for part in parts if "properties" not in part for word in words(part) or []]
    return found or None


def variants(schema: Schema) -> list[Schema]:
    """The kinds of an object with a tag, such as a lens."""
    return [part for part in schema.get("oneOf", []) if "properties" in part]


def not_null(schema: Schema) -> Schema:
    """A schema without the `null` that an absent field stands for."""
    if isinstance(schema.get("type"), list):
        return {**schema, "type": next(kind for kind in schema["type"] if kind != "null")}
    if "anyOf" in schema:
        parts = [part for part in schema["anyOf"] if part.get("type") != "null"]
        return {**schema, **parts[0]} if len(parts) == 1 else {**schema, "anyOf": parts}
    return schema


def text_of(schema: Schema) -> str:
    return " ".join(schema.get("description", "").split())


# Python


def python() -> str:
    types = Types()
    parts = [PYTHON_HEAD]
    parts += [python_type(name, schema) for name, schema in types.types.items() if name not in BY_HAND]
    parts.append(python_open(types.open))
    answers = "".join(f'    "{kind}": {name},\n' for kind, name in ANSWERS.items())
    parts.append(f"ANSWERS: dict[str, type[Any]] = {{\n{answers}}}\n")
    text = parts[0]
    for before, part in itertools.pairwise(parts):
        # Two empty lines around a class, one between other definitions.
        text += "\n\n" if re.search("^class ", before + part, re.M) else "\n"
        text += part
    return text


PYTHON_HEAD = '''"""The messages of the protocol as dataclasses. Generated by clients/generate.py; do not edit.

The names of the fields are those of the protocol. A field that is None is absent from the message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Union

from .pose import Motion, Pose
'''

# What a class has besides its fields.
BASES = {"Ego": "Motion"}


def python_type(name: str, schema: Schema) -> str:
    texts = words(schema)
    if texts:
        literal = f"{name} = Literal[{', '.join(quoted(word) for word in texts)}]"
        if len(literal) > 120:
            literal = f"{name} = Literal[\n" + "".join(f"    {quoted(word)},\n" for word in texts) + "]"
        return f"{literal}\n{docstring(text_of(schema), '')}"
    if "anyOf" in schema:
        parts = [python_kind(part) for part in schema["anyOf"]]
        # Not `X | Y`: Python 3.10 evaluates it, and refuses a text.
        return f"{name} = Union[{', '.join(parts)}]  # noqa: UP007\n{docstring(text_of(schema), '')}"
    fields = variants(schema)
    if fields:
        properties: dict[str, Schema] = {}
        for part in fields:
            for field, inner in part["properties"].items():
                properties.setdefault(field, inner)
        tag = next(field for field, inner in properties.items() if "const" in inner)
        properties[tag] = {**properties[tag], "enum": [part["properties"][tag]["const"] for part in fields]}
        del properties[tag]["const"]
        schema = {**schema, "properties": properties, "required": [tag], "is_merged": True}
    base = f"({BASES[name]})" if name in BASES else ""
    lines = [f"@dataclass(frozen=True)\nclass {name}{base}:\n", docstring(text_of(schema), "    ")]
    blank = "\n"
    for field in ordered(name, schema):
        inner = not_null(schema["properties"][field])
        kind = python_kind(inner, is_merged=schema.get("is_merged", False))
        default = python_default(name, field, inner, schema)
        if default == "None" or (name, field) in REQUIRED:
            kind += " | None"
        lines.append(f"{blank}    {field}: {kind}" + (f" = {default}" if default else "") + "\n")
        lines.append(docstring(text_of(inner if "description" in inner else schema["properties"][field]), "    "))
        blank = ""
    return "".join(lines)


def ordered(name: str, schema: Schema) -> list[str]:
    required = [field for field in schema.get("required", []) if field in schema["properties"]]
    listed = ORDER.get(name, required)
    return listed + sorted(schema["properties"].keys() - listed, key=lambda field: (field not in required, field))


def python_default(name: str, field: str, inner: Schema, schema: Schema) -> str | None:
    if (name, field) in DEFAULTS:
        return DEFAULTS[name, field]
    if field in schema.get("required", []) or (name, field) in REQUIRED:
        return None
    default = inner.get("default")
    if schema.get("is_merged") or default is None or isinstance(default, dict):
        return "None"
    if isinstance(default, list):
        return f"({', '.join(repr(item) for item in default)})"
    return quoted(default) if isinstance(default, str) else repr(default)


def python_kind(schema: Schema, is_merged: bool = False) -> str:
    schema = not_null(schema)
    if "$ref" in schema:
        return renamed(schema["$ref"].rpartition("/")[2])
    texts = words(schema)
    if texts:
        return f"Literal[{', '.join(quoted(word) for word in texts)}]"
    if "anyOf" in schema:
        return " | ".join(python_kind(part) for part in schema["anyOf"])
    kind = schema.get("type")
    if kind == "array":
        item = python_kind(schema["items"], is_merged)
        count = schema.get("minItems")
        if count is None or count != schema.get("maxItems") or is_merged:
            return f"tuple[{item}, ...]"
        return f"tuple[{', '.join([item] * count)}]"
    if kind == "object" and "properties" in schema:
        # A field that has this object alone, as a start has a pose, stands for the object.
        unnamed = unnamed_object(schema)
        return unnamed or python_kind(next(iter(schema["properties"].values())))
    if kind == "object":
        values = schema.get("additionalProperties", True)
        return f"dict[str, {'Any' if values is True else python_kind(values)}]"
    return {"integer": "int", "number": "float", "string": "str", "boolean": "bool"}.get(kind, "Any")


def python_open(schema: Schema) -> str:
    lines = ["\nclass OpenOptions(TypedDict, total=False):\n", docstring("Options of `open`.", "    "), "\n"]
    for field in sorted(schema["properties"].keys() - OPEN_OWN):
        inner = schema["properties"][field]
        kind = OPEN_TYPES.get(field) or python_kind(inner)
        lines.append(f"    {field}: {kind} | None\n")
        lines.append(docstring(text_of(inner), "    "))
    return "".join(lines).lstrip("\n")


def quoted(text: str) -> str:
    return json.dumps(text)


def docstring(text: str, indent: str) -> str:
    if not text:
        return ""
    text = text.replace("\\", "\\\\")
    one = f'{indent}"""{text}"""'
    if len(one) <= 120:
        return one + "\n"
    for width in (120, 117):
        lines = textwrap.wrap(f'"""{text}', width - len(indent), break_on_hyphens=False, break_long_words=False)
        if len(indent + lines[-1]) <= 117:
            break
    return "".join(f"{indent}{line}\n" for line in lines[:-1]) + f'{indent}{lines[-1]}"""\n'


# TypeScript


def typescript() -> str:
    types = Types()
    parts = [TYPESCRIPT_HEAD]
    answered = {name: kind for kind, name in ANSWERS.items()}
    for name, schema in types.types.items():
        if name not in BY_HAND:
            parts.append(typescript_type(name, schema, answered.get(name)))
    return "".join(parts)


TYPESCRIPT_HEAD = """// The messages of wildcity.v1. Generated by clients/generate.py; do not edit.

import type { Pose } from "./pose";
"""


def typescript_type(name: str, schema: Schema, answer: str | None) -> str:
    head = f"\n/** {text_of(schema)} */\n" if text_of(schema) else "\n"
    if len(head) > 122:
        head = "\n/**\n" + "".join(f" * {line}\n" for line in textwrap.wrap(text_of(schema), 116)) + " */\n"
    if "properties" not in schema:
        parts = words(schema) and [quoted(word) for word in words(schema) or []]
        parts = parts or [typescript_kind(part) for part in schema.get("anyOf", []) or variants(schema)]
        one = f"export type {name} = {' | '.join(parts)};"
        if len(one) > 120:
            one = f"export type {name} =\n" + "\n".join(f"  | {part}" for part in parts) + ";"
        return f"{head}{one}\n"
    tag = f'  type: "{answer}";\n' if answer else ""
    lines = [f"{head}export interface {name} {{\n{tag}"]
    for field, inner in schema["properties"].items():
        optional = "" if field in schema.get("required", []) else "?"
        lines.append(f"  {field}{optional}: {typescript_kind(inner)};\n")
    return "".join(lines) + "}\n"


def typescript_kind(schema: Schema) -> str:
    schema = not_null(schema)
    if "$ref" in schema:
        return renamed(schema["$ref"].rpartition("/")[2])
    texts = words(schema)
    if texts:
        return " | ".join(quoted(word) for word in texts)
    if "anyOf" in schema:
        return " | ".join(typescript_kind(part) for part in schema["anyOf"])
    kind = schema.get("type")
    if kind == "array":
        item = typescript_kind(schema["items"])
        count = schema.get("minItems")
        if count is not None and count == schema.get("maxItems"):
            return f"[{', '.join([item] * count)}]"
        return f"({item})[]" if "|" in item else f"{item}[]"
    if kind == "object" and "properties" in schema:
        required = schema.get("required", [])
        fields = [
            f"{field}{'' if field in required else '?'}: {typescript_kind(inner)}"
            for field, inner in schema["properties"].items()
        ]
        return "{ " + "; ".join(fields) + " }"
    if kind == "object":
        values = schema.get("additionalProperties", True)
        return f"Record<string, {'unknown' if values is True else typescript_kind(values)}>"
    return {"integer": "number", "number": "number", "string": "string", "boolean": "boolean"}.get(kind, "unknown")


# The blocking client


def blocking() -> str:
    """The client for asyncio without `await`."""
    text = read(ASYNCIO)
    head = '"""The blocking client. Generated from `aio` by clients/generate.py; do not edit."""\n\nfrom __future__'
    text = head + text.partition("from __future__")[2]
    for pattern, plain in [
        (r"async def __a(enter|exit)__", r"def __\1__"),
        (r"async (def|with)", r"\1"),
        (r"await ", ""),
        (r"AsyncTransport", "BlockingTransport"),
        (r"\ban `with", "a `with"),
        (r"\bAn `with", "A `with"),
    ]:
        text = re.sub(pattern, plain, text)
    return text


if __name__ == "__main__":
    main()
