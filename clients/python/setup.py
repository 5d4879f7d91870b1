"""Builds the package. SEESE3_BINARY names a built `seese3`: the wheel then carries the program, is one of this platform
alone, and needs no Rust where it is installed. Without it, the wheel is for every platform, and looks for the program
in the PATH.
"""

import os
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

BINARY = os.environ.get("SEESE3_BINARY")


class BuildWithProgram(build_py):
    def run(self) -> None:
        super().run()
        if BINARY:
            folder = Path(self.build_lib) / "seese3" / "bin"
            folder.mkdir(exist_ok=True)
            shutil.copy2(BINARY, folder / "seese3")


class PlatformWheel(bdist_wheel):
    def finalize_options(self) -> None:
        super().finalize_options()
        self.root_is_pure = not BINARY

    def get_tag(self) -> tuple[str, str, str]:
        # The program links no Python: any version of it may carry the program.
        python, abi, platform = super().get_tag()
        return ("py3", "none", platform) if BINARY else (python, abi, platform)


setup(
    packages=["seese3", "seese3.v1"],
    package_data={"seese3": ["py.typed"], "seese3.v1": ["*.binpb", "*.pyi"]},
    entry_points={"console_scripts": ["seese3 = seese3.program:main"]},
    cmdclass={"build_py": BuildWithProgram, "bdist_wheel": PlatformWheel},
)
