"""The wheel holds the package alone, with the settings of the repository."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile

import pytest

pytestmark = pytest.mark.thorough

SOURCES = ("polarnet", "stages", "studies", "conf", "params.yaml", "dvc.yaml", "pyproject.toml", "setup.py",
           "MANIFEST.in", "README.md", "LICENSE")  # fmt: skip
BUILD = "import setuptools.build_meta as backend; backend.build_{kind}({folder!r})"  # what pip calls


@pytest.fixture(scope="module")
def distributions(project_root, tmp_path_factory):
    """The source distribution, and the wheel that is built from it."""
    root = tmp_path_factory.mktemp("distributions")
    clone = root / "clone"
    clone.mkdir()
    for name in SOURCES:
        if (project_root / name).is_dir():
            shutil.copytree(project_root / name, clone / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(project_root / name, clone / name)
    for readme in project_root.glob("data/**/README.md"):
        (clone / readme.relative_to(project_root)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(readme, clone / readme.relative_to(project_root))
    sdist = built(clone, "sdist", root)
    with tarfile.open(sdist) as archive:
        archive.extractall(root, filter="data")
    return sdist, built(root / sdist.name.removesuffix(".tar.gz"), "wheel", root)


def built(source, kind, folder):
    before = set(folder.iterdir())
    command = [sys.executable, "-c", BUILD.format(kind=kind, folder=str(folder))]
    subprocess.run(command, cwd=source, check=True, capture_output=True, env=os.environ | {"PYTHONPATH": ""})
    (distribution,) = set(folder.iterdir()) - before
    return distribution


def test_the_wheel_holds_the_package_alone_with_the_settings(distributions, project_root):
    with zipfile.ZipFile(distributions[1]) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
        settings = {name.removeprefix("polarnet/config/settings/"): wheel.read(name) for name in names
                    if name.startswith("polarnet/config/settings/")}  # fmt: skip
    modules = {str(path.relative_to(project_root)) for path in (project_root / "polarnet").rglob("*.py")}
    assert {
        name for name in names - {f"polarnet/config/settings/{one}" for one in settings} if name.endswith(".py")
    } == modules
    assert {name.split("/")[0] for name in names} == {"polarnet"}
    assert {"polarnet/networks/weights/polarnet.safetensors", "polarnet/reports/page.html.jinja"} <= names
    patterns = ("params.yaml", "dvc.yaml", "conf/**/*.yaml", "stages/*.py", "data/**/README.md")
    expected = [path for pattern in patterns for path in project_root.glob(pattern)]
    assert settings == {str(path.relative_to(project_root)): path.read_bytes() for path in expected}
