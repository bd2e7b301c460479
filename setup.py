"""Puts the settings into the wheel: a copy of params.yaml and conf/. Everything else stands in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SETTINGS = ("params.yaml", "conf")
INSTALLED = Path("polarnet", "config", "settings")  # polarnet.runtime.files.shipped_settings reads it


class BuildWithSettings(build_py):
    """Copies params.yaml and conf/ into the built package; an editable installation reads those of the clone."""

    def run(self) -> None:
        """Build, then copy."""
        super().run()
        if self.editable_mode:
            return
        folder = Path(self.build_lib) / INSTALLED
        shutil.rmtree(folder, ignore_errors=True)
        for name in SETTINGS:
            for source in sorted(path for path in (Path(name), *Path(name).rglob("*.yaml")) if path.is_file()):
                target = folder / source
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)


setup(cmdclass={"build_py": BuildWithSettings})
