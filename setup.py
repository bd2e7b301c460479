"""Puts the settings and the pipeline into the wheel, as copies. Everything else stands in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SETTINGS = ("params.yaml", "dvc.yaml", "conf/**/*.yaml", "stages/*.py", "data/**/README.md")
INSTALLED = Path("polarnet", "config", "settings")  # polarnet.terminal.installation.shipped_settings reads it


class BuildWithSettings(build_py):
    """Copies params.yaml and conf/ into the built package; an editable installation reads those of the clone."""

    def run(self) -> None:
        """Build, then copy."""
        super().run()
        if self.editable_mode:
            return
        folder = Path(self.build_lib) / INSTALLED
        shutil.rmtree(folder, ignore_errors=True)
        for source in (path for pattern in SETTINGS for path in sorted(Path().glob(pattern))):
            target = folder / source
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)


setup(cmdclass={"build_py": BuildWithSettings})
