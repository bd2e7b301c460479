import hashlib
import http.server
import json
import os
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from skimage.filters import sobel_h, sobel_v
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from polarnet import lpips
from polarnet.lpips import BACKBONES, Weights, find_weights, write_weights
from polarnet.similarity import (
    Lpips,
    LpipsConfig,
    aolp_error_deg,
    correlation,
    gradient_agreement,
    level_mse,
    lpips_problem,
    mse,
    pattern_mse,
    psnr,
    spread_mse,
    ssim,
)

SHARED = os.environ.get("POLARNET_SHARED")
needs_shared = pytest.mark.skipif(SHARED is None, reason="POLARNET_SHARED names no folder of reference material")


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(3)
    smooth = torch.linspace(0, 1, 31).expand(2, 24, 31)
    return smooth.clone(), (smooth + 0.2 * torch.rand(2, 24, 31, generator=generator)).clamp(0, 1)


def config(backbone="squeeze", path=None, required=False):
    return LpipsConfig(backbone, path, required)


def test_an_offset_of_a_tenth_is_20_db_and_all_level():
    a, b = torch.full((3, 8, 8), 0.5), torch.full((3, 8, 8), 0.6)
    torch.testing.assert_close(mse(a, b), torch.full((3,), 0.01))
    torch.testing.assert_close(psnr(a, b), torch.full((3,), 20.0))
    torch.testing.assert_close(level_mse(a, b), mse(a, b))
    torch.testing.assert_close(pattern_mse(a, b), torch.zeros(3), atol=1e-12, rtol=0)


def test_level_and_pattern_add_up_to_the_squared_error(pair):
    a, b = (x.double() for x in pair)
    torch.testing.assert_close(level_mse(a, b) + pattern_mse(a, b), mse(a, b), rtol=1e-12, atol=0)


def test_equal_frames_have_100_db_ssim_1_and_correlation_1(pair):
    a, _ = pair
    assert psnr(a, a).tolist() == [100.0, 100.0]
    torch.testing.assert_close(ssim(a, a), torch.ones(2))
    torch.testing.assert_close(correlation(a, a), torch.ones(2))


def test_correlation_ignores_gain_and_offset_but_not_sign(pair):
    a, _ = pair
    torch.testing.assert_close(correlation(a, 0.3 * a + 0.1), torch.ones(2))
    torch.testing.assert_close(correlation(a, 1 - a), -torch.ones(2))


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3])
def test_a_constant_frame_correlates_0_with_anything_and_has_a_gradient(pair, value):
    constant = torch.full((2, 24, 31), value, requires_grad=True)
    scores = correlation(constant, pair[0])
    assert scores.tolist() == [0.0, 0.0]
    scores.sum().backward()
    assert constant.grad.isfinite().all()


def test_correlation_is_that_of_numpy(pair):
    a, b = pair
    expected = [np.corrcoef(x.flatten(), y.flatten())[0, 1] for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(correlation(a, b), expected, rtol=1e-6)


def test_ssim_is_that_of_torchmetrics(pair):
    a, b = (x.double() for x in pair)
    for i in range(2):
        expected = structural_similarity_index_measure(
            b[i][None, None], a[i][None, None], gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0
        )
        torch.testing.assert_close(ssim(a, b)[i], expected, rtol=1e-7, atol=0)
        assert ssim(*(x.float() for x in (a, b)))[i].item() == pytest.approx(expected.item(), rel=1e-4)


def test_ssim_is_that_of_scikit_image_where_its_window_meets_no_border():
    # a pattern of period 26 whose mirror at both borders continues it: every pixel is as an interior one
    phase = torch.arange(27, dtype=torch.float64) * torch.pi / 13
    a = 0.5 + 0.4 * torch.cos(phase)[:, None] * torch.cos(phase)
    b = 0.5 + 0.3 * torch.cos(2 * phase)[:, None] * torch.cos(phase)
    tiles = [torch.cat([x, x[1:], x[1:]]) for x in (a, b)]
    tiles = [torch.cat([x, x[:, 1:], x[:, 1:]], dim=1) for x in tiles]
    _, expected = structural_similarity(
        *(x.numpy() for x in tiles), data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        full=True,
    )  # fmt: skip
    middle = expected[26:53, 26:53].mean()
    assert ssim(a, b).item() == pytest.approx(middle, abs=1e-12)


def test_ssim_of_two_constants_is_their_luminance_term():
    a, b = torch.full((12, 12), 0.4, dtype=torch.float64), torch.full((12, 12), 0.6, dtype=torch.float64)
    assert ssim(a, b).item() == pytest.approx((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4), rel=1e-12)


def test_ssim_has_the_gradient_of_its_finite_differences():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(1, 7, 6, generator=generator, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a.requires_grad_())


def test_ssim_keeps_float32_under_autocast(pair):
    a, b = pair
    with torch.autocast("cpu", torch.bfloat16):
        inside = ssim(a, b)
    assert torch.equal(inside, ssim(a, b))


def test_ssim_of_a_frame_smaller_than_half_its_window_is_refused():
    with pytest.raises(ValueError, match="at least 6 pixels a side, got \\(5, 40\\)"):
        ssim(torch.zeros(5, 40), torch.zeros(5, 40))


def test_mse_and_psnr_are_those_of_scikit_image(pair):
    a, b = (x.double() for x in pair)
    for i in range(2):
        pictures = b[i].numpy(), a[i].numpy()
        assert mse(a, b)[i].item() == pytest.approx(mean_squared_error(*pictures), rel=1e-12)
        assert psnr(a, b)[i].item() == pytest.approx(peak_signal_noise_ratio(*pictures, data_range=1), rel=1e-12)


def test_the_spread_is_the_error_of_the_frames_own_mean(pair):
    _, b = pair
    torch.testing.assert_close(spread_mse(b), mse(b.mean(dim=(-2, -1), keepdim=True).expand_as(b), b))


def test_gradients_of_equal_ramps_agree_and_half_as_steep_a_one_agrees_less():
    ramp = torch.linspace(0, 1, 9).expand(7, 9)
    assert gradient_agreement(ramp, ramp + 0.1).item() == pytest.approx(1)
    assert gradient_agreement(ramp, 0.5 * ramp).item() == pytest.approx(2 * 0.5 / (1 + 0.25))
    assert gradient_agreement(ramp, -ramp).item() == pytest.approx(-1)
    assert gradient_agreement(ramp, torch.linspace(0, 1, 7)[:, None].expand(7, 9)).item() == pytest.approx(0, abs=1e-7)


def test_gradient_agreement_is_that_of_scikit_images_sobel(pair):
    a, b = (x.double() for x in pair)
    # scikit-image's kernels sum to 1 on either side of the centre; ours take the slope per pixel: half as much
    along = [[f(x[0].numpy())[1:-1, 1:-1] for f in (sobel_h, sobel_v)] for x in (a, b)]
    common = sum((x * y).sum() for x, y in zip(*along, strict=True))
    energy = sum((x * x).sum() for gradient in along for x in gradient)
    assert gradient_agreement(a, b)[0].item() == pytest.approx(2 * common / energy, rel=1e-12)


def test_a_constant_frame_agrees_with_no_gradient():
    assert gradient_agreement(torch.full((5, 5), 1 / 3), torch.rand(5, 5)).item() == 0
    with pytest.raises(ValueError, match="at least 3 pixels a side"):
        gradient_agreement(torch.zeros(2, 9), torch.zeros(2, 9))


@pytest.mark.parametrize(
    ("a_deg", "b_deg", "error"), [(10, 30, 20), (175, 5, 10), (0, 90, 90), (0, 180, 0), (1, 179, 2), (40, 140, 80)]
)
def test_the_angle_between_two_orientations_goes_the_shorter_way_round(a_deg, b_deg, error):
    a, b = (torch.full((1, 2, 2), float(np.deg2rad(x)), dtype=torch.float64) for x in (a_deg, b_deg))
    assert aolp_error_deg(a, b, torch.ones(1, 2, 2)).item() == pytest.approx(error, abs=1e-9)
    assert aolp_error_deg(b, a, torch.ones(1, 2, 2)).item() == pytest.approx(error, abs=1e-9)


def test_an_angle_weighs_as_much_as_the_light_is_polarized():
    error = torch.tensor([[0.0, np.deg2rad(40)]])
    assert aolp_error_deg(error, 0 * error, torch.tensor([[0.9, 0.3]])).item() == pytest.approx(10, abs=1e-5)
    assert aolp_error_deg(error, 0 * error, torch.tensor([[0.9, 0.0]])).item() == 0


def test_pixels_that_are_not_valid_count_in_no_gradient_angle_or_spread(pair):
    a, b = pair
    valid = torch.ones(2, 24, 31, dtype=torch.bool)
    valid[:, :, 20:] = False
    spoilt = torch.where(valid, a, 7.0)
    known, other = a[..., :20], b[..., :20]
    torch.testing.assert_close(gradient_agreement(spoilt, b, valid), gradient_agreement(known, other))
    torch.testing.assert_close(aolp_error_deg(spoilt, b, b, valid), aolp_error_deg(known, other, other))
    torch.testing.assert_close(spread_mse(spoilt, valid), spread_mse(known))


def test_without_polarization_an_angle_is_right_by_chance():
    zero = torch.zeros(2, 3, 3)
    assert aolp_error_deg(zero, zero, zero).tolist() == [45.0, 45.0]
    random = torch.rand(1, 300, 300, generator=torch.Generator().manual_seed(0)) * torch.pi
    assert aolp_error_deg(random, torch.zeros(1, 300, 300), torch.ones(1, 300, 300)).item() == pytest.approx(
        45, abs=0.3
    )


def test_leading_axes_are_kept(pair):
    a, b = (x.view(1, 2, 24, 31) for x in pair)
    for score in (mse, psnr, ssim, correlation, level_mse, pattern_mse, gradient_agreement):
        assert score(a, b).shape == (1, 2)


@pytest.mark.parametrize(("backbone", "parameters"), [("squeeze", 722_496), ("alex", 2_469_696), ("vgg", 14_714_688)])
def test_a_backbone_has_the_parameters_of_torchvisions_features(backbone, parameters):
    with torch.device("meta"):
        layers = BACKBONES[backbone].features()
    assert sum(p.numel() for p in layers.parameters()) == parameters


@pytest.mark.parametrize("backbone", ["squeeze", "alex", "vgg"])
def test_taps_have_the_channels_that_the_heads_expect(backbone):
    features = Lpips(backbone).features(torch.rand(1, 64, 64))
    assert tuple(x.shape[1] for x in features) == BACKBONES[backbone].channels


@pytest.mark.parametrize(("backbone", "side"), [("squeeze", 17), ("alex", 31), ("vgg", 16)])
def test_the_smallest_image_that_a_backbone_takes(backbone, side):
    distance = Lpips(backbone)
    assert distance(torch.zeros(1, side, side), torch.ones(1, side, side)).isfinite().all()
    with pytest.raises(ValueError, match=rf"LPIPS \({backbone}\) needs images of {side} pixels a side"):
        distance.features(torch.zeros(1, 50, side - 1))


def test_lpips_is_0_for_equal_images_symmetric_and_reaches_only_the_images():
    torch.manual_seed(0)
    distance = Lpips("squeeze")
    a, b = torch.rand(2, 2, 40, 48, generator=torch.Generator().manual_seed(0))
    assert distance(a, a).tolist() == [0.0, 0.0]
    torch.testing.assert_close(distance(a, b), distance(b, a))
    distance(a.requires_grad_(), b).sum().backward()
    assert a.grad.isfinite().all()
    assert a.grad.abs().sum() > 0
    assert all(p.grad is None for p in distance.parameters())


def test_lpips_of_a_grey_image_is_that_of_three_equal_channels():
    distance = Lpips("squeeze")
    a, b = torch.rand(2, 1, 40, 48, generator=torch.Generator().manual_seed(0))
    rgb = [x[:, None].expand(-1, 3, -1, -1) for x in (a, b)]
    torch.testing.assert_close(distance(a, b), distance(*rgb))


def test_a_blank_image_has_a_finite_gradient():
    blank = torch.zeros(1, 40, 40, requires_grad=True)
    Lpips("squeeze")(blank, torch.rand(1, 40, 40)).sum().backward()
    assert blank.grad.isfinite().all()


@pytest.fixture(scope="module")
def published():
    file = Path(SHARED) / "weights" / "lpips_squeeze_v0.1.npz"
    return Lpips.of("squeeze", find_weights(config(path=str(file))).tensors)


def check_pair(kernel):
    with np.load(Path(SHARED) / "weights" / "lpips_squeeze_check.npz") as arrays:
        return torch.from_numpy(arrays[f"pair{kernel}"])


@needs_shared
@pytest.mark.parametrize(("kernel", "expected"), [(3, 0.124705), (7, 0.336987), (15, 0.492556)])
def test_lpips_of_the_check_pairs(published, kernel, expected):
    a, b = check_pair(kernel).permute(0, 3, 1, 2)[:, None]
    assert published(a, b).item() == pytest.approx(expected, abs=2e-6)


@needs_shared
def test_lpips_of_the_grey_check_pair_in_float32_and_near_it_in_bf16(published):
    a, b = check_pair(7).mean(-1)[:, None]
    assert published(a, b).item() == pytest.approx(0.360800, abs=2e-6)
    with torch.autocast("cpu", torch.bfloat16):
        low = published(a, b)
    assert low.dtype == torch.float32
    assert low.item() == pytest.approx(0.360800, rel=0.05)


@needs_shared
def test_torchmetrics_heads_are_the_published_ones():
    with np.load(Path(SHARED) / "weights" / "lpips_squeeze_v0.1.npz") as arrays:
        backbone = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name.startswith("features")}
        heads = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name.startswith("lin")}
    found = lpips._checked("squeeze", backbone, Path("x"))
    assert all(torch.equal(found[name], head) for name, head in heads.items())


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch hub cache, and a squeeze backbone whose published file name carries the hash of our random one."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    folder = tmp_path / "torch" / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    monkeypatch.setattr(lpips, "REACH_TIMEOUT_S", 0.5)
    monkeypatch.setattr(lpips, "MODELS_URL", "http://127.0.0.1:9/")  # the discard port: nothing answers
    torch.manual_seed(1)
    layers = BACKBONES["squeeze"].features()
    classifier = {"classifier.1.weight": torch.zeros(4, 512, 1, 1)}
    state = {f"features.{name}": value for name, value in layers.state_dict().items()} | classifier
    torch.save(state, tmp_path / "made.pth")
    content = (tmp_path / "made.pth").read_bytes()
    name = f"squeezenet1_1-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    monkeypatch.setitem(BACKBONES, "squeeze", BACKBONES["squeeze"]._replace(file=name))
    return folder, name, content


def test_weights_in_the_hub_cache_are_found_without_the_classifier_and_loaded_back(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    assert lpips_problem(config()) is None
    weights = find_weights(config())
    assert weights.source == name
    assert weights.reason is None
    assert not any(key.startswith("classifier") for key in weights.tensors)
    write_weights(tmp_path / "out", "squeeze", weights)
    loaded = Lpips.load(tmp_path / "out")
    image = torch.rand(1, 40, 40)
    expected = Lpips.of("squeeze", weights.tensors)(image, 1 - image)
    assert torch.equal(loaded(image, 1 - image), expected)


def test_the_same_weights_from_a_file_given_by_path_give_the_same_bytes(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    write_weights(tmp_path / "cache", "squeeze", find_weights(config()))
    (tmp_path / name).write_bytes(content)
    write_weights(tmp_path / "path", "squeeze", find_weights(config(path=str(tmp_path / name))))
    for file in ("lpips.json", "lpips.safetensors"):
        assert (tmp_path / "cache" / file).read_bytes() == (tmp_path / "path" / file).read_bytes()


def test_npz_and_safetensors_files_are_read_too(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    tensors = find_weights(config()).tensors
    save_file(tensors, tmp_path / "w.safetensors")
    np.savez(tmp_path / "w.npz", **{key: value.numpy() for key, value in tensors.items()})
    for file in ("w.safetensors", "w.npz"):
        again = find_weights(config(path=str(tmp_path / file))).tensors
        assert again.keys() == tensors.keys()
        assert all(torch.equal(again[key], value) for key, value in tensors.items())


def test_a_damaged_file_in_the_hub_cache_is_not_used(hub):
    folder, name, content = hub
    (folder / name).write_bytes(content[:-1])
    assert find_weights(config()) == Weights(None, None, f"{name} in torch's hub cache is damaged")


def test_without_a_network_the_search_fails_fast_and_says_where_to_put_the_file(hub, tmp_path):
    folder, name, _ = hub
    start = time.perf_counter()
    weights = find_weights(config())
    problem = lpips_problem(config())
    assert time.perf_counter() - start < 5
    assert weights.tensors is None
    assert weights.reason == f"{name} is not in torch's hub cache and could not be downloaded"
    assert str(folder / name) in problem
    assert "lpips.path" in problem
    write_weights(tmp_path / "out", "squeeze", weights)
    record = json.loads((tmp_path / "out" / "lpips.json").read_text())
    assert record == {"backbone": "squeeze", "reason": weights.reason, "sha256": None, "source": None}
    assert Lpips.load(tmp_path / "out") is None


def test_with_a_network_the_file_is_downloaded_into_the_hub_cache(hub, tmp_path, monkeypatch):
    folder, name, content = hub
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / name).write_bytes(content)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path / "served")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setattr(lpips, "MODELS_URL", f"http://127.0.0.1:{server.server_port}/")
        assert lpips_problem(config()) is None
        assert not (folder / name).exists()
        assert find_weights(config()).source == name
        server.shutdown()
    assert (folder / name).read_bytes() == content


def test_weights_that_a_stage_already_wrote_are_no_problem_elsewhere(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    write_weights(tmp_path / "out", "squeeze", find_weights(config()))
    (folder / name).unlink()
    assert lpips_problem(config(), tmp_path / "out") is None
    assert lpips_problem(config("vgg"), tmp_path / "out") is not None
    assert lpips_problem(config(), tmp_path / "elsewhere") is not None


def test_a_path_that_names_no_file_or_other_weights_is_an_error(hub, tmp_path):
    missing = str(tmp_path / "missing.npz")
    assert "there is no file" in lpips_problem(config(path=missing))
    with pytest.raises(ValueError, match=r"lpips.path: there is no file .*missing.npz"):
        find_weights(config(path=missing))
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(ValueError, match=r"text.pth: expected weights as .pth, .npz or .safetensors"):
        find_weights(config(path=str(tmp_path / "text.pth")))
    (tmp_path / "made.pth").write_bytes(hub[2])
    with pytest.raises(ValueError, match=r"made.pth: these are not the weights of LPIPS's vgg backbone"):
        find_weights(config("vgg", str(tmp_path / "made.pth")))


def test_weights_that_are_not_those_of_the_record_are_refused(hub, tmp_path):
    folder, name, content = hub
    (folder / name).write_bytes(content)
    write_weights(tmp_path, "squeeze", find_weights(config()))
    file = tmp_path / "lpips.safetensors"
    file.write_bytes(file.read_bytes()[:-4] + b"\0\0\0\0")
    with pytest.raises(ValueError, match=r"not the file that lpips.json describes"):
        Lpips.load(tmp_path)


def test_an_unknown_backbone_is_refused():
    with pytest.raises(ValueError, match="backbone: expected one of squeeze, alex, vgg, got 'resnet'"):
        config("resnet")


PIXELWISE = [mse, level_mse, pattern_mse, psnr, correlation]


@pytest.mark.parametrize("metric", PIXELWISE)
def test_a_masked_frame_scores_like_the_part_that_is_valid(pair, metric):
    valid = torch.zeros(2, 24, 31, dtype=torch.bool)
    valid[:, 3:20, 5:30] = True
    part = [x[:, 3:20, 5:30] for x in pair]
    torch.testing.assert_close(metric(*pair, valid), metric(*part), rtol=1e-5, atol=1e-7)


def test_masked_ssim_is_the_mean_of_the_map_over_the_valid_pixels(pair):
    """scikit-image's map, which it makes in its own way; the frames agree where they are masked."""
    truth, other = pair
    valid = torch.zeros(24, 31, dtype=torch.bool)
    valid[6:12, 8:20] = True
    mixed = torch.where(valid, other, truth)
    for a, b, score in zip(mixed, truth, ssim(mixed, truth, valid.expand(2, -1, -1)), strict=True):
        options = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        _, whole = structural_similarity(a.numpy(), b.numpy(), full=True, **options)
        assert score.item() == pytest.approx(float(whole[valid.numpy()].mean()), abs=1e-5)


@pytest.mark.parametrize("metric", [*PIXELWISE, ssim])
def test_what_lies_outside_a_mask_does_not_matter(pair, metric):
    predicted, truth = pair
    valid = torch.rand(2, 24, 31, generator=torch.Generator().manual_seed(5)) < 0.7
    spoilt = torch.where(valid, predicted, 1 - predicted)
    assert not torch.equal(metric(spoilt, truth), metric(predicted, truth))
    assert torch.equal(metric(spoilt, truth, valid), metric(predicted, truth, valid))


@pytest.mark.parametrize("metric", [*PIXELWISE, ssim])
def test_a_mask_that_masks_nothing_changes_nothing_and_one_that_masks_all_leaves_no_number(pair, metric):
    everywhere = torch.ones(2, 24, 31, dtype=torch.bool)
    torch.testing.assert_close(metric(*pair, everywhere), metric(*pair))
    assert metric(*pair, ~everywhere).isnan().all()


@pytest.mark.parametrize("metric", [mse, psnr, ssim, correlation, gradient_agreement, level_mse, pattern_mse])
def test_numpy_gives_what_torch_gives(pair, metric):
    a, b = pair
    valid = b > 0.2
    assert torch.equal(metric(a.numpy(), b.numpy()), metric(a, b))
    assert torch.equal(metric(a.numpy(), b.numpy(), valid.numpy()), metric(a, b, valid))


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_a_truth_of_another_data_range_is_refused(pair, metric):
    a, b = pair
    with pytest.raises(ValueError, match=r"b: expected frames in \[0, 1\], got values up to 255; divide by 255"):
        metric(255 * a, 255 * b / b.max())
    metric(3 * a, b)  # a prediction may exceed it
    metric(a, torch.where(a > 0.5, 255, b), a <= 0.5)  # so may what nobody looks at


@pytest.mark.parametrize("metric", [mse, psnr, ssim, correlation, gradient_agreement, level_mse, pattern_mse])
def test_frames_of_bytes_or_of_different_shapes_are_refused(unchecked_annotations, pair, metric):
    a, b = pair
    with pytest.raises(ValueError, match=r"a: expected floating-point numbers, got torch\.uint8; divide by 255"):
        metric((255 * a).byte(), b)
    with pytest.raises(ValueError, match=r"expected a and b of one shape, got a \(2, 24, 31\), b \(24, 31\)"):
        metric(a, b[0])
    with pytest.raises(ValueError, match="valid: expected a mask, bool of shape"):
        metric(a, b, b)


def test_lpips_takes_numpy_and_refuses_bytes_and_a_truth_of_another_range(unchecked_annotations):
    network = Lpips("squeeze")
    a, b = torch.rand(2, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    assert torch.equal(network(a.numpy(), b.numpy()), network(a, b))
    with pytest.raises(ValueError, match=r"images: expected floating-point numbers, got torch\.uint8"):
        network((255 * a).byte(), b)
    with pytest.raises(ValueError, match=r"b: expected images in \[0, 1\], got values up to 2\d\d.*; divide by 255"):
        network(a, 255 * b)
