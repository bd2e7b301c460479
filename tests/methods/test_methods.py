"""Every record: what it gives, what it needs, and that state goes in and comes out."""

import dataclasses
import hashlib
import math

import pytest
import torch
from method_fixtures import WITH_WEIGHTS_HERE

from polarnet.config.tree import load
from polarnet.events.representations import event_counts, voxel_grid
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow, encode_windows
from polarnet.methods import METHODS
from polarnet.methods.dolp_network import dolp_recoverer, weighted_counts
from polarnet.methods.intensities import from_intensities, with_gain
from polarnet.methods.intensity_networks import intensity_methods, load_baseline, sharper
from polarnet.methods.method import Method, Recoverer, weights_record, why_absent
from polarnet.networks.e2p.network import E2p, interleaved
from polarnet.networks.e2v.network import FireNet
from polarnet.networks.polarnet.stokes_unet import StokesUNet
from polarnet.stokes import Prediction, intensities_from_stokes, stokes_from_polarization

COUNTS = {"network": "polarnet", "representation": "event_counts"}
RECONSTRUCTING = [name for name, method in METHODS.items() if method.reconstructs and method.wraps is None]


def recovered(recoverer, windows):
    """All windows in one step from the start."""
    first = windows[0].channels[0]
    return recoverer.step(recoverer.start(first.height, first.width), windows)[1]


def assert_same(prediction, other):
    torch.testing.assert_close(prediction.dolp, other.dolp, atol=2e-5, rtol=1e-4)
    assert (prediction.aolp is None) == (other.aolp is None)
    if prediction.aolp is not None:
        angle = prediction.aolp - other.aolp
        assert (torch.sin(angle).abs() * other.dolp).max() < 1e-3  # of period pi, and undefined without polarization


@pytest.fixture
def open_method(make_setup):
    def opened(name, **changes):
        method = METHODS[name]
        return method.open(make_setup(method.section, **changes))

    return opened


@pytest.mark.parametrize("name", [name for name in METHODS if name in WITH_WEIGHTS_HERE])
def test_every_method_gives_a_frame_a_window_alike_at_once_and_one_by_one(name, sequence, open_method):
    recoverer, windows = open_method(name), sequence.windows()
    together = recovered(recoverer, windows)
    assert together.dolp.shape == sequence.dolp.shape
    assert together.dolp.dtype == torch.float32
    assert 0 <= together.dolp.min() <= together.dolp.max() <= 1
    if together.aolp is not None:
        assert together.aolp.shape == sequence.dolp.shape
        assert 0 <= together.aolp.min() <= together.aolp.max() < math.pi
    state = recoverer.start(sequence.events[0].height, sequence.events[0].width)
    for k, window in enumerate(windows):
        before = state
        state, one = recoverer.step(before, [window])
        assert torch.equal(recoverer.step(before, [window])[1].dolp, one.dolp)  # neither has changed
        assert_same(one, Prediction(together.dolp[k : k + 1], None if one.aolp is None else together.aolp[k : k + 1]))
    nothing = EventWindow([Events.empty(18, 20)] * 4, 0, 1000)
    assert recovered(recoverer, [nothing]).dolp.isfinite().all()


def test_dolp_is_clamped_for_every_method_and_more_is_handed_on_where_there_is_more(sequence):
    wild = torch.linspace(-1, 2, sequence.dolp.numel()).view_as(sequence.dolp)
    recoverer = Recoverer(lambda height, width: None, lambda state, windows: (state, Prediction(wild)))
    assert torch.equal(recovered(recoverer, sequence.windows()).dolp, wild.clamp(0, 1))

    class Sure(torch.nn.Module):
        def unroll(self, inputs, state):
            maps = inputs[:, :, 0]
            return Prediction(3 + maps, 0.5 + 0 * maps, maps), [maps]

    prediction = recovered(dolp_recoverer(Sure(), {"representation": "voxel_grid"}), sequence.windows()[:1])
    assert prediction.dolp.max() <= 1
    assert prediction.aolp.unique().tolist() == [0.5]
    assert prediction.log_variance.shape == (1, 18, 20)


def test_cf_of_one_event_behind_one_polarizer_which_counts_from_the_window_that_it_opens(sequence, open_method):
    row, column = torch.tensor([2], dtype=torch.int16), torch.tensor([3], dtype=torch.int16)
    one = Events(torch.tensor([1000]), column, row, torch.ones(1, dtype=torch.int8), 18, 20)
    silent = Events.empty(18, 20)
    lit = dataclasses.replace(sequence, events=[one, silent, silent, silent])
    dolp = recovered(open_method("cf"), lit.windows()).dolp
    dark = 0.1 / 1.3  # what a pixel without events shows: exp(0) - 1 = 0, and -0.1 ... 1.2 is shown as 0 ... 1
    bright = [(math.expm1(0.1 * math.exp(-math.pi * t)) + 0.1) / 1.3 for t in (1e-3, 2e-3, 3e-3)]
    expected = [0.0, *((b - dark) / (b + dark) for b in bright)]  # at 1000 us it lies in [1000, 2000), not in [0, 1000)
    torch.testing.assert_close(dolp[:, 2, 3], torch.tensor(expected))
    dolp[:, 2, 3] = 0
    assert not dolp.any()


@pytest.mark.parametrize("name", RECONSTRUCTING)
def test_reconstructions_treat_the_four_polarizers_alike(name, sequence, open_method):
    turned = dataclasses.replace(sequence, events=[*sequence.events[1:], sequence.events[0]])
    straight, shifted = (recovered(open_method(name), one.windows()).intensities for one in (sequence, turned))
    assert straight.shape == (4, 4, 18, 20)
    assert 0 <= straight.min() < straight.max() <= 1
    torch.testing.assert_close(shifted, straight.roll(-1, dims=1))


def reconstructing(intensities):
    """A method that reconstructs these, whatever it sees."""

    def predict(state, windows):
        return state + len(windows), from_intensities(intensities[state : state + len(windows)])

    return Method("known", "known", "#000000", lambda setup: Recoverer(lambda *_: 0, predict), reconstructs=True)


def test_solved_gains_undo_what_a_method_left_unknown(sequence, make_setup):
    s0, dolp, aolp = 0.5 + 0.5 * sequence.s0, 0.9 * sequence.dolp, sequence.aolp
    true = intensities_from_stokes(stokes_from_polarization(s0, dolp, aolp))
    method = reconstructing(true * torch.tensor([1.5, 0.7, 1.0, 0.8]).view(4, 1, 1))
    setup = make_setup("cf")
    assert [METHODS[f"{name}+gain"].section for name in RECONSTRUCTING] == RECONSTRUCTING
    solved = recovered(with_gain(method).open(setup), sequence.windows())
    torch.testing.assert_close(solved.dolp, dolp, atol=1e-3, rtol=0)
    assert not torch.allclose(recovered(method.open(setup), sequence.windows()).dolp, dolp, atol=0.1)


def test_published_networks_are_sharpened_and_firenet_plus_sees_plain_voxels(sequence, make_setup, open_method):
    setup = make_setup("firenetplus_published")
    network = load_baseline({"firenet": FireNet}, setup.weights)
    grids = encode_windows(sequence.events, sequence.t_us, lambda events, _: voxel_grid(events, 5)).unflatten(1, (4, 5))
    with torch.no_grad():
        raw, _ = network.unroll(grids)
    intensities = recovered(open_method("firenetplus_published"), sequence.windows()).intensities
    torch.testing.assert_close(intensities, sharper(raw))
    (normalised, _) = intensity_methods("m", "m", "#000000", {"firenet": FireNet}, sharpened=True)
    assert not torch.allclose(intensities, recovered(normalised.open(setup), sequence.windows()).intensities)


def test_e2p_sees_the_channels_as_a_mosaic_and_carries_its_state_on(sequence, open_method, checkpoints):
    grids = encode_windows(sequence.events, sequence.t_us, lambda events, _: voxel_grid(events, 5))
    network = load_baseline({"e2p": E2p}, checkpoints["e2p"])
    with torch.no_grad():
        maps, _ = network.unroll(interleaved(grids.unflatten(1, (4, 5)))[:, None])
    prediction = recovered(open_method("e2p"), sequence.windows())
    torch.testing.assert_close(prediction.dolp, maps[:, 0, 2].clamp(0, 1))
    assert prediction.aolp is not None


def test_an_event_of_half_the_threshold_counts_half(sequence):
    events = sequence.windows()[0].channels[0]
    polarity, count = event_counts(events, 1)
    assert torch.equal(weighted_counts((1.0, 1.0))(events, 1), torch.stack([polarity, count]))
    change, steps = weighted_counts((0.5, 1.0))(events, 1)
    assert torch.equal(steps + change, (count + polarity) / 2)
    assert torch.equal(steps - change, count - polarity)


@pytest.fixture
def stokes_unet(project_root):
    return StokesUNet(load(project_root).networks.polarnet)


def test_a_network_that_is_told_thresholds_or_blocks_of_pixels_uses_them(sequence, stokes_unet, project_root):
    given = recovered(dolp_recoverer(stokes_unet, COUNTS, thresholds=(0.1, 0.4)), sequence.windows()[:1])
    assert stokes_unet.scale.given == pytest.approx(0.2 / stokes_unet.step)
    inputs = encode_windows(sequence.events, sequence.t_us[:2], weighted_counts((0.5, 2.0)))[:, None]
    with torch.no_grad():
        torch.testing.assert_close(given.dolp, stokes_unet.unroll(inputs)[0].dolp[:, 0].clamp(0, 1))
    coarse = StokesUNet(dataclasses.replace(load(project_root).networks.polarnet, binning=2))
    coarse.load_state_dict(stokes_unet.state_dict())
    stokes_unet.scale.given = None
    told_at_use = recovered(dolp_recoverer(stokes_unet, COUNTS, binning=2), sequence.windows())
    assert dolp_recoverer(stokes_unet, COUNTS, binning=2).at_once(1, 1) >= 1  # a sensor smaller than a block
    assert torch.equal(told_at_use.dolp, recovered(dolp_recoverer(coarse, COUNTS), sequence.windows()).dolp)


@pytest.mark.parametrize(("network", "option", "words"), [
    ("paper", {"binning": 2}, "binning: expected network polarnet, got paper; leave binning out"),
    ("polarnet", {"binning": 9}, "side of 1 to 8 px, got 9"),
    ("paper", {"thresholds": (0.1, 0.1)}, "expected network polarnet, got paper; leave thresholds out"),
    ("polarnet", {"thresholds": (0.1, 0.0)}, r"expected 0\.001 to 10"),
])  # fmt: skip
def test_options_that_the_network_cannot_use_are_refused(network, option, words, stokes_unet):
    chosen = stokes_unet if network == "polarnet" else torch.nn.Identity()
    with pytest.raises(ValueError, match=words):
        dolp_recoverer(chosen, COUNTS | {"network": network}, **option)


def test_a_method_without_weights_says_what_to_do(make_setup, checkpoints, tmp_path):
    absent = {
        name: why_absent(METHODS[name], make_setup(METHODS[name].section, weights=weights))
        for name, weights in {
            "cf+gain": None,
            "e2v": checkpoints["firenet"],
            "firenet_published": None,
            "firenet_published+gain": None,
            "paper": tmp_path / "none.safetensors",
            "e2p": checkpoints["firenet"],
        }.items()
    }
    assert absent["cf+gain"] is absent["e2v"] is None
    assert "rows.firenet_published+gain.needs" in absent["firenet_published+gain"]
    assert "with their file as rows.firenet_published.needs" in absent["firenet_published"]
    assert absent["paper"] == f"{tmp_path / 'none.safetensors'} is not there"
    assert absent["e2p"].endswith("a firenet, expected e2p: set rows.e2p.needs to such a file")


def test_weights_are_named_by_hash_and_others_refused(open_method, checkpoints, tmp_path, make_setup):
    with pytest.raises(FileNotFoundError, match=r"none.safetensors is missing"):
        open_method("ours", weights=tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="holds a firenet, expected a e2p"):
        open_method("e2p", weights=checkpoints["firenet"])
    with pytest.raises(ValueError, match="holds a e2p, expected a firenet or e2vid"):
        open_method("e2v", weights=checkpoints["e2p"])
    digest = hashlib.sha256(checkpoints["firenet"].read_bytes()).hexdigest()
    record = {"file": "firenet.safetensors", "sha256": digest, "network": "firenet"}
    assert weights_record(METHODS["e2v"], make_setup("e2v")) == record
    for name, network in {"ours": "paper", "cista_tc": "cista_tc"}.items():
        assert weights_record(METHODS[name], make_setup(name))["network"] == network
