"""Writes docs/api.md from the protos. Reads the descriptors that `buf build proto -o -#format=json` prints."""

import json
import sys

FIRST = "Generated from `proto/seese3/v1` by `just api`; the words are those of the protos."


def comments(file):
    """The comments of a file by the path of what they describe."""
    locations = file.get("sourceCodeInfo", {}).get("location", [])
    found = {}
    for location in locations:
        text = location.get("leadingComments", "")
        lines = [line[1:] if line.startswith(" ") else line for line in text.strip("\n").split("\n")]
        found[tuple(location.get("path", []))] = "\n".join(lines).strip()
    return found


def anchor(name):
    return name.lower().replace(".", "")


def map_entries(message):
    """The (key, value) fields of each map of a message, by the name of the map's entry."""
    nested = message.get("nestedType", [])
    return {entry["name"]: entry["field"] for entry in nested if entry.get("options", {}).get("mapEntry")}


def type_of(field, maps):
    """The type of a field, with a link where it has its own section."""
    entry = maps.get(field.get("typeName", "").rsplit(".", 1)[-1])
    if entry:
        key, value = (type_of({**side, "proto3Optional": False, "label": ""}, {}) for side in entry)
        return f"map of {key} to {value}"
    plain = field["type"].removeprefix("TYPE_").lower()
    full = field.get("typeName", "").removeprefix(".")
    name = full.removeprefix("seese3.v1.")
    if full.startswith("seese3.v1."):
        plain = f"[{name}](#{anchor(name)})"
    elif full:
        plain = name
    if field.get("label") == "LABEL_REPEATED":
        return f"repeated {plain}"
    if field.get("proto3Optional"):
        return f"optional {plain}"
    return plain


def one_line(text):
    return " ".join(text.split()).replace("|", "\\|")


def message_lines(message, path, said):
    yield f"### {message['name']}"
    yield ""
    yield said.get(path, "")
    yield ""
    fields = message.get("field", [])
    if not fields:
        return
    maps = map_entries(message)
    oneofs = [oneof["name"] for oneof in message.get("oneofDecl", [])]
    for index, oneof in enumerate(oneofs):
        words = one_line(said.get((*path, 8, index), ""))
        if words:
            yield f"`{oneof}`: {words}"
            yield ""
    yield "| field | type | meaning |"
    yield "| --- | --- | --- |"
    for index, field in enumerate(fields):
        meaning = one_line(said.get((*path, 2, index), ""))
        if "oneofIndex" in field and not field.get("proto3Optional"):
            meaning = f"One of `{oneofs[field['oneofIndex']]}`. {meaning}"
        yield f"| `{field['name']}` = {field['number']} | {type_of(field, maps)} | {meaning} |"
    yield ""


def enum_lines(enum, path, said):
    yield f"### {enum['name']}"
    yield ""
    yield said.get(path, "")
    yield ""
    yield "| value | meaning |"
    yield "| --- | --- |"
    for index, value in enumerate(enum["value"]):
        yield f"| `{value['name']}` = {value.get('number', 0)} | {one_line(said.get((*path, 2, index), ''))} |"
    yield ""


def rpc_signature(method):
    def side(key, streaming):
        name = method[key].rsplit(".", 1)[-1]
        stream = "stream " if method.get(streaming) else ""
        return f"{stream}[{name}](#{anchor(name)})"

    return f"({side('inputType', 'clientStreaming')}) → {side('outputType', 'serverStreaming')}"


def file_lines(file):
    said = comments(file)
    for number, service in enumerate(file.get("service", [])):
        yield f"## {service['name']}"
        yield ""
        yield said.get((6, number), "")
        yield ""
        yield "| RPC | | meaning |"
        yield "| --- | --- | --- |"
        for index, method in enumerate(service["method"]):
            meaning = one_line(said.get((6, number, 2, index), ""))
            yield f"| `{method['name']}` | {rpc_signature(method)} | {meaning} |"
        yield ""
    if not file.get("service"):
        yield "## Shared messages"
        yield ""
        # The comment above `package`.
        yield said.get((2,), "")
        yield ""
    for number, message in enumerate(file.get("messageType", [])):
        yield from message_lines(message, (4, number), said)
    for number, enum in enumerate(file.get("enumType", [])):
        yield from enum_lines(enum, (5, number), said)


def main():
    files = [file for file in json.load(sys.stdin)["file"] if file["name"].startswith("seese3/")]
    # Services first, in the order of the alphabet; what they share last.
    files.sort(key=lambda file: (not file.get("service"), file["name"]))
    lines = ["# API reference", "", FIRST, ""]
    for file in files:
        lines.extend(file_lines(file))
    print("\n".join(lines).rstrip())


if __name__ == "__main__":
    main()
