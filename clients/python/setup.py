"""Builds the package: the protocol's stubs, the synchronous client and, if it is named, the program are added to it.

- SEESE3_PROTO names the folder of the protos; without it, that of the repository around this package is used.
- SEESE3_BINARY names a built `seese3`. The wheel then carries it, is one of this platform alone, and needs no Rust
  where it is installed. Without it, the wheel is for every platform, and looks for the program in the PATH.
"""

import os
import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

HERE = Path(__file__).resolve().parent
BINARY = os.environ.get("SEESE3_BINARY")

# The synchronous client is the asynchronous one without `async` and `await`: what is written twice comes apart.
SYNCHRONOUS = [
    (r'^"""The asynchronous client: .*$', '"""The client, made from aio.py when the package is built."""'),
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


def make_stubs(target: str) -> None:
    import grpc_tools
    from grpc_tools import protoc

    well_known = Path(grpc_tools.__file__).parent / "_proto"
    protos = Path(os.environ.get("SEESE3_PROTO", HERE.parent.parent / "proto"))
    files = sorted((protos / "seese3" / "v1").glob("*.proto"))
    if not files:
        raise FileNotFoundError(f"no protos in {protos}: set SEESE3_PROTO to the folder that has seese3/v1/*.proto")

    outputs = [f"--{kind}_out={target}" for kind in ("python", "pyi", "grpc_python")]
    arguments = ["protoc", f"-I{protos}", f"-I{well_known}", *outputs]
    if protoc.main(arguments + [str(file) for file in files]) != 0:
        raise RuntimeError("protoc failed")


def make_synchronous(package: Path) -> None:
    text = (package / "aio.py").read_text()
    for pattern, replacement in SYNCHRONOUS:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    (package / "client.py").write_text(text)


class BuildWithParts(build_py):
    def run(self) -> None:
        super().run()
        package = Path(self.build_lib) / "seese3"
        make_stubs(self.build_lib)
        make_synchronous(package)

        if BINARY:
            (package / "bin").mkdir(exist_ok=True)
            shutil.copy2(BINARY, package / "bin" / "seese3")


class PlatformWheel(bdist_wheel):
    def finalize_options(self) -> None:
        super().finalize_options()
        self.root_is_pure = not BINARY

    def get_tag(self) -> tuple[str, str, str]:
        # The program links no Python: any version of it may carry the program.
        python, abi, platform = super().get_tag()
        return ("py3", "none", platform) if BINARY else (python, abi, platform)


setup(
    packages=["seese3"],
    package_data={"seese3": ["py.typed"]},
    entry_points={"console_scripts": ["seese3 = seese3.program:main"]},
    cmdclass={"build_py": BuildWithParts, "bdist_wheel": PlatformWheel},
)
