import dataclasses
import hashlib
import math
from pathlib import Path

import pytest
import torch

from polarnet.baselines.e2p import interleaved
from polarnet.baselines.postprocessing import postprocessed
from polarnet.baselines.trivial import oracle_mean
from polarnet.evaluation.methods import (
    INTENSITY_METHODS,
    METHODS,
    NEEDED,
    Polarization,
    WeightsConfig,
    available,
    checkpoints_of,
    from_intensities,
    network_intensities,
    recover,
    weights_used,
    with_gain,
)
from polarnet.events.representations import event_tensor, voxel_grid
from polarnet.events.stream import Events
from polarnet.events.windows import encode_windows
from polarnet.networks.checkpoint import load_network
from polarnet.similarity import mse
from polarnet.stokes import intensities_from_stokes, stokes_from_polarization


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_a_frame_a_window_between_0_and_1(method, recording, context):
    found = recover(method, recording, context)
    assert found.dolp.shape == recording.dolp.shape
    assert found.dolp.dtype == torch.float32
    assert 0 <= found.dolp.min() <= found.dolp.max() <= 1
    assert found.seconds > 0
    if found.aolp is not None:
        assert found.aolp.shape == recording.dolp.shape
        assert 0 <= found.aolp.min() <= found.aolp.max() < math.pi


@pytest.mark.parametrize("method", [name for name in METHODS if name != "oracle_mean"])
def test_only_the_oracle_looks_at_the_truth(method, recording, context):
    blind = dataclasses.replace(recording, dolp=torch.full_like(recording.dolp, 0.5))
    assert torch.equal(recover(method, recording, context).dolp, recover(method, blind, context).dolp)


@pytest.mark.parametrize("method", ["zeros", "train_mean", "oracle_mean"])
def test_the_trivial_rows_look_at_no_event(method, recording, context):
    still = dataclasses.replace(recording, events=[Events.empty(18, 20)] * 4)
    assert torch.equal(recover(method, recording, context).dolp, recover(method, still, context).dolp)


@pytest.mark.parametrize("constant", [0.0, 0.25, 0.45, 0.5, 0.55, 1.0])
def test_the_oracle_mean_beats_every_constant_on_every_frame(constant, recording, context):
    oracle = recover("oracle_mean", recording, context).dolp
    assert (mse(oracle, recording.dolp) <= mse(torch.full_like(oracle, constant), recording.dolp)).all()


def test_dolp_outside_0_and_1_is_clamped_in_one_place(recording, context, monkeypatch):
    wild = torch.linspace(-1, 2, recording.dolp.numel()).view_as(recording.dolp)
    monkeypatch.setitem(METHODS, "wild", lambda *_: Polarization(wild))
    assert torch.equal(recover("wild", recording, context).dolp, wild.clamp(0, 1))


def test_intensities_become_dolp_and_aolp_by_the_stokes_formula(recording, context):
    intensities = torch.tensor([0.8, 0.5, 0.2, 0.5]).view(1, 4, 1, 1)
    found = from_intensities(lambda *_: intensities)(recording, context)
    torch.testing.assert_close(found.dolp, torch.full((1, 1, 1), 0.6))
    torch.testing.assert_close(found.aolp, torch.zeros(1, 1, 1))


def test_cf_of_one_event_behind_one_polarizer(recording, context):
    row, column = torch.tensor([2], dtype=torch.int16), torch.tensor([3], dtype=torch.int16)
    one = Events(torch.tensor([1000]), column, row, torch.ones(1, dtype=torch.int8), 18, 20)
    silent = Events.empty(18, 20)
    lit = dataclasses.replace(recording, events=[one, silent, silent, silent])
    found = recover("cf", lit, context).dolp
    dark = 0.1 / 1.3  # what a pixel without events shows: exp(0) - 1 = 0, and -0.1 ... 1.2 is shown as 0 ... 1
    bright = [(math.expm1(0.1 * math.exp(-math.pi * t)) + 0.1) / 1.3 for t in (1e-3, 2e-3, 3e-3)]
    expected = [0.0, *((b - dark) / (b + dark) for b in bright)]  # at the first frame's time, so it shows in the second
    torch.testing.assert_close(found[:, 2, 3], torch.tensor(expected))
    found[:, 2, 3] = 0
    assert not found.any()


def test_ours_runs_window_by_window_with_its_state_carried_on(recording, context):
    network, _ = load_network(context.ours_checkpoint)
    inputs = encode_windows(recording.events, recording.t_us, event_tensor)
    with torch.no_grad():
        at_once, _ = network.unroll(inputs[:, None])
    expected = at_once.dolp[:, 0].clamp(0, 1)
    torch.testing.assert_close(recover("ours", recording, context).dolp, expected)


@pytest.mark.parametrize("row", INTENSITY_METHODS)
@torch.no_grad()
def test_intensity_methods_treat_the_four_polarizers_alike(row, recording, context):
    turned = dataclasses.replace(recording, events=[*recording.events[1:], recording.events[0]])
    straight, shifted = (INTENSITY_METHODS[row](one, context) for one in (recording, turned))
    assert straight.shape == (4, 4, 18, 20)
    assert 0 <= straight.min() < straight.max() <= 1
    torch.testing.assert_close(shifted, straight.roll(-1, dims=1))


@pytest.mark.parametrize("row", INTENSITY_METHODS)
def test_every_intensity_method_has_a_row_with_its_gains_solved(row):
    assert {row, f"{row}+gain"} <= set(METHODS)


def test_solved_gains_undo_what_a_method_left_unknown(recording, context):
    s0, dolp, aolp = 0.5 + 0.5 * recording.s0, 0.9 * recording.dolp, recording.aolp
    true = intensities_from_stokes(stokes_from_polarization(s0, dolp, aolp))
    unknown = true * torch.tensor([1.5, 0.7, 1.0, 0.8]).view(4, 1, 1)
    found = from_intensities(with_gain(lambda *_: unknown))(recording, context)
    torch.testing.assert_close(found.dolp, dolp, atol=1e-3, rtol=0)
    assert not torch.allclose(from_intensities(lambda *_: unknown)(recording, context).dolp, dolp, atol=0.1)


@torch.no_grad()
def test_published_networks_are_post_processed_and_firenet_plus_sees_voxels_as_they_are(recording, context):
    raw = network_intensities(lambda c: c.firenetplus_published, normalised=False)(recording, context)
    shown = INTENSITY_METHODS["firenetplus_published"](recording, context)
    torch.testing.assert_close(shown, postprocessed(raw, context.postprocessing))
    normalised = network_intensities(lambda c: c.firenetplus_published)(recording, context)
    assert not torch.allclose(raw, normalised)


@torch.no_grad()
def test_e2p_sees_the_channels_as_a_mosaic_and_carries_its_state_on(recording, context):
    grids = encode_windows(recording.events, recording.t_us, lambda events, _: voxel_grid(events, 5))
    maps, _ = context.e2p.unroll(interleaved(grids.unflatten(1, (4, 5)))[:, None])
    torch.testing.assert_close(recover("e2p", recording, context).dolp, maps[:, 0, 2].clamp(0, 1))
    assert recover("e2p", recording, context).aolp is not None


def test_bf16_is_near_fp32(recording, context):
    low = dataclasses.replace(context, precision="bf16")
    for method in ("firenet", "e2p", "ours"):
        a, b = (recover(method, recording, c).dolp for c in (context, low))
        assert 0 < (a - b).abs().mean() < 0.02


def test_a_network_that_was_not_trained_is_missed_by_its_methods_alone(recording, context, tmp_path):
    without = dataclasses.replace(context, ours_checkpoint=tmp_path / "none.safetensors")
    recover("cf", recording, without)
    with pytest.raises(FileNotFoundError, match=r"none.safetensors is missing"):
        recover("ours", recording, without)


def test_the_oracle_knows_the_mean_of_the_valid_pixels_alone():
    truth = torch.rand(3, 4, 5)
    valid = truth < 0.6
    valid[1] = False
    best = oracle_mean(truth, valid)
    for frame, mean, where in zip(truth, best, valid, strict=True):
        expected = frame[where].mean() if where.any() else torch.tensor(0.0)
        torch.testing.assert_close(mean, expected.expand(4, 5))


def test_a_row_without_weights_is_left_out_with_the_reason(context, checkpoints, tmp_path):
    gone = dataclasses.replace(
        context,
        firenet_published_checkpoint=None,
        paper_checkpoint=tmp_path / "none.safetensors",
        e2vid_checkpoint=checkpoints["firenet_checkpoint"],
    )
    wanted = ["zeros", "cf+gain", "e2vid", "firenet", "firenet_published", "firenet_published+gain", "paper", "ours"]
    there, left_out = available(wanted, gone)
    assert there == ["zeros", "cf+gain", "firenet", "ours"]
    assert left_out["firenet_published+gain"] == left_out["firenet_published"]
    assert "set baselines.weights.firenet_published" in left_out["firenet_published"]
    assert left_out["paper"] == f"{tmp_path / 'none.safetensors'} is not there"
    assert left_out["e2vid"].endswith(
        "a firenet, expected e2vid: set baselines.weights.e2vid to such a file, or train "
        "one with baselines.e2v.arch=e2vid"
    )
    assert available(list(METHODS), context) == (list(METHODS), {})


def test_a_checkpoint_of_another_network_is_refused(recording, context, checkpoints):
    wrong = dataclasses.replace(context, e2p_checkpoint=checkpoints["firenet_checkpoint"])
    with pytest.raises(ValueError, match="holds a firenet, expected a e2p"):
        recover("e2p", recording, wrong)


def test_files_of_the_configuration_come_before_what_the_stages_left(tmp_path):
    config = WeightsConfig(**{field.name: None for field in dataclasses.fields(WeightsConfig)})
    stages = (tmp_path / "train", tmp_path / "e2v", tmp_path / "e2p")
    left = checkpoints_of(config, *stages)
    assert left["firenet_checkpoint"] == left["e2vid_checkpoint"] == tmp_path / "e2v" / "best.safetensors"
    assert left["ours_checkpoint"] == tmp_path / "train" / "best.safetensors"
    assert left["firenet_published_checkpoint"] is None
    own = checkpoints_of(dataclasses.replace(config, e2p="my.safetensors", e2vid_published="x.pth.tar"), *stages)
    assert (own["e2p_checkpoint"], own["e2vid_published_checkpoint"]) == (Path("my.safetensors"), Path("x.pth.tar"))
    assert own.keys() == left.keys() == {f"{row}_checkpoint" for row in NEEDED}
    with pytest.raises(ValueError, match="e2p: expected the path of a file or null"):
        dataclasses.replace(config, e2p=" ")


def test_the_weights_behind_a_table_are_named_by_their_hash(context, checkpoints):
    used = weights_used(["cf", "firenet", "firenet+gain"], context)
    content = checkpoints["firenet_checkpoint"].read_bytes()
    assert used == {
        "firenet": {"file": "firenet.safetensors", "sha256": hashlib.sha256(content).hexdigest(), "network": "firenet"}
    }


@pytest.mark.shared
def test_the_published_weights_of_firenet_make_rows(recording, context, shared):
    files = {
        "firenet_published_checkpoint": shared / "weights" / "firenet_1000.pth.tar",
        "firenetplus_published_checkpoint": shared / "weights" / "firenetplus_state_dict.pth",
    }
    with_files = dataclasses.replace(context, **files)
    for row in ("firenet_published", "firenet_published+gain", "firenetplus_published"):
        assert recover(row, recording, with_files).dolp.std() > 0.01
