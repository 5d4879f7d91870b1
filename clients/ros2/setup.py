"""Builds the package, and the stubs of the server's protocol with it.

The protos lie beside the package in its repository; SEESE3_PROTO names their folder where only the package was copied.
"""

import os
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PACKAGE = "seese3_bridge"
HERE = Path(__file__).resolve().parent


class BuildWithStubs(build_py):
    """Adds seese3/v1/*_pb2.py to what is built."""

    def run(self):
        super().run()
        import grpc_tools
        from grpc_tools import protoc

        well_known = Path(grpc_tools.__file__).parent / "_proto"
        protos = Path(os.environ.get("SEESE3_PROTO", HERE.parent.parent / "proto"))
        files = sorted((protos / "seese3" / "v1").glob("*.proto"))
        if not files:
            raise FileNotFoundError(f"no protos in {protos}: set SEESE3_PROTO to the folder that has seese3/v1/*.proto")

        arguments = ["protoc", f"-I{protos}", f"-I{well_known}", f"--python_out={self.build_lib}", f"--grpc_python_out={self.build_lib}"]
        if protoc.main(arguments + [str(file) for file in files]) != 0:
            raise RuntimeError("protoc failed")


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Has a SeeSE3 server follow a robot's camera",
    license="MIT OR Apache-2.0",
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", ["launch/bridge.launch.py"]),
        (f"share/{PACKAGE}/config", ["config/bridge.yaml"]),
    ],
    install_requires=["setuptools", "grpcio", "protobuf", "pillow"],
    zip_safe=True,
    entry_points={"console_scripts": [f"bridge = {PACKAGE}.node:main"]},
    cmdclass={"build_py": BuildWithStubs},
)
