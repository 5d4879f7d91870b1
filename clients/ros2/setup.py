"""Builds the package."""

from setuptools import setup

PACKAGE = "seese3_bridge"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Has a SeeSE3 server follow a robot's camera",
    license="MIT OR Apache-2.0",
    packages=[PACKAGE, f"{PACKAGE}.v1"],
    package_data={f"{PACKAGE}.v1": ["descriptors.binpb"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", ["launch/bridge.launch.py"]),
        (f"share/{PACKAGE}/config", ["config/bridge.yaml"]),
    ],
    install_requires=["setuptools", "grpcio", "protobuf", "pillow"],
    zip_safe=False,
    entry_points={"console_scripts": [f"bridge = {PACKAGE}.node:main"]},
)
