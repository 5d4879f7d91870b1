"""Makes what is derived from other files; run it after a change of the protos or of `seese3/aio.py`.

- `seese3/client.py`, the synchronous client, from the asynchronous one: what is written twice comes apart.
- `seese3/v1/descriptors.binpb` and `seese3/v1/*_pb2.pyi`, the descriptors of the protos and the types of the messages,
  by grpcio-tools; also for the ROS bridge.

`generate.py --check` changes nothing, and fails if a file is not as it would be made.
"""

import re
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROTOS = HERE.parent.parent / "proto"
PACKAGE = HERE / "seese3"
BRIDGE = HERE.parent / "ros2" / "seese3_bridge"

SYNCHRONOUS = [
    (r'^"""The asynchronous client: .*$', '"""The client, made from aio.py by generate.py: change that file."""'),
    (r"\basync def\b", "def"),
    (r"\basync (for|with)\b", r"\1"),
    (r"\bawait (anext)\b", "next"),
    (r"\bawait ", ""),
    (r"\bAsync(Client|Track)\b", r"\1"),
    (r"\bAsync(Iterator|Iterable|Generator)\b", r"\1"),
    (r"__a(enter|exit|iter)__", r"__\1__"),
    (r"__anext__", "__next__"),
    (r"\bStopAsyncIteration\b", "StopIteration"),
    (r"\basyncio\.Queue\b", "queue.Queue"),
    (r"^import asyncio$", "import queue\nimport time"),
    (r"\basyncio\.sleep\b", "time.sleep"),
    (r"\bchannel\.open_async\b", "channel.open_sync"),
    (r"\bchannel\.AsyncTimer\b", "channel.SyncTimer"),
    (r"\baclose\b", "close"),
]


def synchronous() -> str:
    text = (PACKAGE / "aio.py").read_text()
    for pattern, replacement in SYNCHRONOUS:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    return text


def derived(folder: Path) -> dict[str, bytes]:
    """The descriptors of the protos, and the types of their messages."""
    import grpc_tools
    from grpc_tools import protoc

    well_known = Path(grpc_tools.__file__).parent / "_proto"
    files = sorted((PROTOS / "seese3" / "v1").glob("*.proto"))
    outputs = [f"--pyi_out={folder}", "--include_imports", f"--descriptor_set_out={folder / 'descriptors.binpb'}"]
    arguments = ["protoc", f"-I{PROTOS}", f"-I{well_known}", *outputs, *map(str, files)]
    if protoc.main(arguments) != 0:
        raise RuntimeError("protoc failed")
    made = {f"v1/{stub.name}": stub.read_bytes() for stub in (folder / "seese3" / "v1").glob("*.pyi")}
    return made | {"v1/descriptors.binpb": (folder / "descriptors.binpb").read_bytes()}


def main() -> int:
    with tempfile.TemporaryDirectory() as temporary:
        made = {"client.py": synchronous().encode(), **derived(Path(temporary))}

    files = {PACKAGE / name: content for name, content in made.items()}
    # The ROS bridge is built where this package is not.
    for name in ("v1/__init__.py", "v1/descriptors.binpb"):
        files[BRIDGE / name] = made.get(name) or (PACKAGE / name).read_bytes()

    stale = [file for file, content in files.items() if _content(file) != content]
    if "--check" in sys.argv:
        for file in stale:
            print(f"{file} is out of date: run generate.py", file=sys.stderr)
        return 1 if stale else 0
    for file in stale:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(files[file])
        print(f"wrote {file.relative_to(HERE.parent)}")
    return 0


def _content(file: Path) -> bytes | None:
    return file.read_bytes() if file.exists() else None


if __name__ == "__main__":
    sys.exit(main())
