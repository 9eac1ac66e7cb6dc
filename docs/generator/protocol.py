"""docs/reference/protocol from the schemas, the OpenAPI document and the golden messages in protocol/."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Schema = dict[str, Any]

FOLDER = "docs/reference/protocol"
# The bodies of HTTP, in the order of their use.
BODIES = [
    "twins",
    "version",
    "drive",
    "rollback",
    "made_version",
    "ground",
    "new_edit",
    "new_upload",
    "upload",
    "new_push",
    "push",
]
BODIES += ["new_actor", "actor", "actors", "session", "episode", "ticket", "refusal"]
HEAD = "<!-- Written by docs/generate.py from protocol/. -->\n\n"
DEFINITIONS = "#/$defs/"
# What a field is that says which variant of a union an object is.
CONSTANTS = {"type": "the kind of the message", "kind": "the kind of the line", "event": "the kind of the event"}
SIMPLE = {
    "string": "text",
    "integer": "integer",
    "number": "number",
    "boolean": "`true` or `false`",
    "object": "object",
    "null": "`null`",
}


def pages(root: Path) -> tuple[dict[str, str], str]:
    schemas = {
        path.stem: plain(json.loads(path.read_text())) for path in sorted((root / "protocol" / "schema").glob("*.json"))
    }
    sockets = {"request", "answer", "observation", "many"}
    if unknown := schemas.keys() ^ (sockets | set(BODIES)):
        raise SystemExit(f"docs/generator/protocol.py and protocol/schema differ: {sorted(unknown)}")
    types: dict[str, Schema] = {}
    for schema in schemas.values():
        for name, definition in schema.get("$defs", {}).items():
            known = types.setdefault(name, definition)
            if outline(known) != outline(definition):
                raise SystemExit(f"two schemas differ in their type {name}")
    vectors = root / "protocol" / "vectors"
    written = {
        "requests": messages("Requests", schemas["request"], vectors / "requests"),
        "answers": messages("Answers", schemas["answer"], vectors / "answers"),
        "observation": observation(schemas["observation"], schemas["many"]),
        "http": http(
            json.loads((root / "protocol" / "openapi.json").read_text()), {name: schemas[name] for name in BODIES}
        ),
        "record": record(json.loads((root / "protocol" / "record.json").read_text())),
        "types": "# Types of messages\n\n" + "".join(section(name, types[name]) for name in sorted(types)),
    }
    return {f"{FOLDER}/{name}.md": HEAD + text.rstrip() + "\n" for name, text in written.items()}, FOLDER


def plain(schema: Any) -> Any:
    """A schema without `null`: the schemas of answers accept it for a field that is absent, and no answer has one."""
    if isinstance(schema, list):
        return [plain(value) for value in schema]
    if not isinstance(schema, dict):
        return schema
    schema = {key: plain(value) for key, value in schema.items()}
    if isinstance(what := schema.get("type"), list):
        schema["type"] = what[0] if what[1:] == ["null"] else what
    if isinstance(variants := schema.get("anyOf"), list) and variants[1:] == [{"type": "null"}]:
        del schema["anyOf"]
        schema.update(variants[0])
    return schema


def outline(schema: Any) -> Any:
    """A schema without what differs between requests, which are closed, and answers, which are open."""
    if isinstance(schema, dict):
        return {key: outline(value) for key, value in schema.items() if key not in ("additionalProperties", "default")}
    return [outline(value) for value in schema] if isinstance(schema, list) else schema


def messages(title: str, schema: Schema, vectors: Path) -> str:
    """One section for each variant of a union, by its `type`, with its golden messages."""
    examples: dict[str, list[str]] = {}
    for path in sorted(vectors.glob("*.json")):
        text = path.read_text().strip()
        examples.setdefault(json.loads(text)["type"], []).append(text)
    text = f"# {title}\n\n{prose(schema)}\n\n"
    for variant in schema["oneOf"]:
        kind = variant["properties"]["type"]["const"]
        text += f"## {kind}\n\n{prose(variant)}\n\n{fields(variant)}"
        for example in examples.pop(kind, []):
            text += f"```json\n{example}\n```\n\n"
    if examples:
        raise SystemExit(f"{vectors}: golden messages of no type: {sorted(examples)}")
    return text


def observation(metadata: Schema, many: Schema) -> str:
    return (
        f"# Metadata of an observation\n\n{prose(metadata)}\n\n{fields(metadata)}"
        f"## Several sessions\n\n{prose(many)}\n\n{fields(many)}"
    )


def record(schema: Schema) -> str:
    """The lines of a record, and their types, which are not those of messages."""
    text = f"# Lines of a record\n\n`protocol/record.json`. {prose(schema)}\n\n"
    for variant in schema["oneOf"]:
        title = variant["title"]
        kind = variant["properties"]["kind"]["const"]
        text += f"## {title if kind == title else f'{kind}: {title}'}\n\n{prose(variant)}\n\n{fields(variant)}"
    for name, definition in schema["$defs"].items():
        text += section(name, definition)
    return text.replace("](types.md#", "](#")


def http(document: Schema, bodies: dict[str, Schema]) -> str:
    text = "# HTTP\n\n## Routes\n\n| route | statuses | |\n|---|---|---|\n"
    for path, operations in sorted(document["paths"].items()):
        for method, operation in operations.items():
            statuses = ", ".join(sorted(status for status in operation["responses"] if status != "default"))
            what = cell(f"{operation.get('summary', '')} {operation.get('description', '')}")
            text += f"| `{method.upper()} {path}` | {statuses} | {what} |\n"
    text += "\n"
    for name, schema in bodies.items():
        text += f"## {schema['title']}\n\n`protocol/schema/{name}.json`. {prose(schema)}\n\n{fields(schema)}"
    return text


def section(name: str, schema: Schema) -> str:
    return f"## {name}\n\n{prose(schema)}\n\n{fields(schema)}"


def fields(schema: Schema) -> str:
    """The properties of an object as a table, or the variants of a union."""
    text = ""
    if properties := schema.get("properties"):
        text += "| field | type | |\n|---|---|---|\n"
        for name, field in properties.items():
            if "const" in field:
                field = {
                    **field,
                    "description": field.get("description", CONSTANTS.get(name, "")),
                }
            needed = " (required)" if name in schema.get("required", []) and "const" not in field else ""
            text += f"| `{name}`{needed} | {kind(field)} | {cell(field.get('description', ''))}{default(field)} |\n"
        text += "\n"
    variants = schema.get("oneOf") or schema.get("anyOf") or []
    if all("const" in variant for variant in variants) and variants:
        text += "| value | |\n|---|---|\n"
        text += (
            "".join(f"| `{variant['const']}` | {cell(variant.get('description', ''))} |\n" for variant in variants)
            + "\n"
        )
    elif variants and all(variant.keys() == {"required"} for variant in variants):
        text += f"One of {', '.join(names(variant['required']) for variant in variants)} is required.\n\n"
    else:
        for place, variant in enumerate(variants, 1):
            what = f": {kind(variant)}" if "$ref" in variant else ""
            text += f"{place}. {prose(variant) or kind(variant)}{what}\n\n{fields(variant)}"
    return text


def names(fields: list[str]) -> str:
    return " with ".join(f"`{field}`" for field in fields)


def kind(field: Schema) -> str:
    """What a value is, in words, with its range."""
    if "$ref" in field:
        name = field["$ref"].removeprefix(DEFINITIONS)
        return f"[{name}](types.md#{name.lower()})"
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    for union in ("oneOf", "anyOf"):
        if union in field:
            return " or ".join(kind(variant) for variant in field[union])
    what = field.get("type", "any JSON")
    if isinstance(what, list):
        return " or ".join(kind({**field, "type": one}) for one in what)
    if what == "array":
        least, most = field.get("minItems"), field.get("maxItems")
        count = (
            f"{least} "
            if least == most and least is not None
            else f"{least} to {most} "
            if most and least
            else f"at most {most} "
            if most
            else ""
        )
        if "prefixItems" in field:
            return f"[{', '.join(kind(item) for item in field['prefixItems'])}]"
        return f"list of {count}{plural(kind(field.get('items', {})))}"
    if what == "object" and isinstance(field.get("additionalProperties"), dict):
        return f"object of {kind(field['additionalProperties'])} by name"
    least, most = field.get("minimum"), field.get("maximum")
    within = ""
    if least is not None and most is not None:
        within = f", {number(least)} to {number(most)}"
    elif least not in (None, 0, 0.0):
        within = f", from {number(least)} on"
    elif most is not None:
        within = f", at most {number(most)}"
    if what == "string" and "pattern" in field:
        return "name" if field["pattern"] == "^[a-z0-9_-][a-z0-9._-]{0,63}$" else f"text `{field['pattern']}`"
    return SIMPLE.get(what, what) + within


def plural(what: str) -> str:
    word, comma, rest = what.partition(",")
    return f"{word}s{comma}{rest}" if word in ("text", "integer", "number", "object", "name") else what


def number(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:g}"


def default(field: Schema) -> str:
    value = field.get("default")
    if value in (None, [], {}) or isinstance(value, dict):
        return ""
    return f" Default: `{json.dumps(value)}`."


def prose(schema: Schema) -> str:
    return str(schema.get("description", "")).replace("\n\n", "\0").replace("\n", " ").replace("\0", "\n\n")


def cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
