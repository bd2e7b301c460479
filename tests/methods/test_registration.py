import numpy as np
import pytest
import torch
from method_fixtures import REGISTRATION

from polarnet.events.representations import event_counts
from polarnet.events.stream import crop, select, slice_time
from polarnet.events.streaming import EventWindow, encode_windows, windows_of
from polarnet.methods import METHODS
from polarnet.methods.registration import Panorama, mosaic, offset_field, register, views
from polarnet.networks.weights import shipped_weights
from polarnet.simulation import MOTIONS, SENSORS, scene_from_polarization, simulate
from polarnet.stokes import StokesFrames


@pytest.fixture(scope="module")
def simulated():
    """A second of a sensor that moves over smooth random light of random polarization."""
    generator = torch.Generator().manual_seed(3)
    planes = torch.nn.functional.interpolate(
        torch.rand(1, 3, 60, 90, generator=generator), (240, 360), mode="bicubic"
    ).clamp(0.02, 0.98)[0]
    scene = scene_from_polarization(planes[0], 0.7 * planes[1], 3.1 * planes[2])
    return simulate(scene, MOTIONS["default"], SENSORS["clean"], seed=1)


@pytest.fixture(scope="module")
def windows(simulated):
    return [
        EventWindow([slice_time(events, *span) for events in simulated.events], *span)
        for span in windows_of(simulated.t_us)
    ]


@pytest.fixture
def open_shipped(make_setup):
    def opened(name, **changes):
        return METHODS[name].open(make_setup("ours", weights=shipped_weights(), **changes))

    return opened


def straight_panorama(height: int, width: int) -> Panorama:
    """The panorama of a sensor of 40x60 pixels that moves to the right."""
    x = np.arange(10.0)
    return Panorama(np.zeros((4, height, width), np.float32), np.ones((height, width), bool), x, np.zeros(10))


def test_motion_and_contrasts_of_a_moving_scene_are_found(simulated):
    counts = encode_windows(simulated.events, simulated.t_us, event_counts).numpy()
    polarity, number = counts[:, 0::2].transpose(1, 0, 2, 3), counts[:, 1::2].transpose(1, 0, 2, 3)
    panorama = register(np.stack([number + polarity, number - polarity], axis=1) / 2, REGISTRATION)
    assert panorama is not None

    pose = simulated.trajectory.pose(simulated.t_us.numpy() * 1e-6)
    for found, true in ((panorama.x, pose.x), (panorama.y, pose.y)):
        assert np.std(found - true) < 0.3

    dolp, aolp = (field[6:].numpy() for field in (simulated.dolp, simulated.aolp))
    truth = np.arctanh(dolp * np.stack([np.cos(2 * aolp), np.sin(2 * aolp)]))
    found = views(panorama.images[:2] - panorama.images[2:], panorama.x[6:], panorama.y[6:], (120, 180))
    for one, true in zip(found, truth, strict=True):
        assert np.corrcoef(one.ravel(), true.ravel())[0, 1] > 0.9


def test_maps_of_a_sensor_are_averaged_where_the_panorama_shows_them():
    panorama = straight_panorama(42, 72)
    image = np.random.default_rng(1).random((1, 42, 72), np.float32)
    maps = views(image, panorama.x, panorama.y, (40, 60))
    weight = np.ones((10, 40, 60), np.float32)
    maps[:, 0], weight[0] = 7.0, 0.0  # an unknown time
    means, seen = mosaic(maps, weight, panorama)
    np.testing.assert_allclose(means[0, :40, 1:69], image[0, :40, 1:69], atol=1e-5)
    assert seen[20, 30] == 9
    assert seen[41].max() == 0


def test_an_offset_of_each_line_along_the_motion_is_found_and_noise_is_not():
    panorama, random = straight_panorama(80, 120), np.random.default_rng(1)
    of_rows = np.sin(np.arange(80) / 12).astype(np.float32)[:, None] * np.ones((1, 120), np.float32)
    noise = random.standard_normal((80, 120)).astype(np.float32)
    found = offset_field(np.stack([of_rows, noise]), np.ones((80, 120), np.float32), panorama, REGISTRATION)
    assert np.abs(found[0] - of_rows)[8:-8].max() < 0.3
    assert np.ptp(found[0], axis=1).max() < 0.05
    assert found[1].std() < 0.05


@pytest.mark.thorough
def test_a_whole_recording_gives_better_maps_than_the_past_alone(simulated, windows, open_shipped):
    errors = {}
    for name in ("ours", "registered"):
        recoverer = open_shipped(name)
        _, prediction = recoverer.step(recoverer.start(120, 180), windows)
        assert prediction.dolp.shape == (30, 120, 180)
        assert 0 <= prediction.aolp.min() <= prediction.aolp.max() < torch.pi
        errors[name] = (prediction.dolp - simulated.dolp[1:])[5:].square().mean()
    assert errors["registered"] < 0.9 * errors["ours"]


@pytest.mark.thorough
def test_the_next_block_is_registered_with_the_windows_before_it(windows, open_shipped):
    recoverer = open_shipped("registered")
    state, _ = recoverer.step(recoverer.start(120, 180), windows[:12])
    kept, latest = recoverer.step(state, windows[12:18])
    assert len(kept.counts) == REGISTRATION.overlap
    again = recoverer.step(state, windows[12:18])[1]
    assert torch.equal(latest.dolp, again.dolp)  # the state before has not changed
    alone = recoverer.step(recoverer.start(120, 180)._replace(inner=state.inner), windows[12:18])[1]
    assert not torch.equal(latest.dolp, alone.dolp)


def test_a_lone_last_window_sees_the_panorama_and_the_frames_of_the_block_before_it(simulated, windows, open_shipped):
    """On a quarter of the sensor, to save time."""
    part = [
        EventWindow([crop(one, 30, 45, 60, 90) for one in window.channels], window.start_us, window.stop_us)
        for window in windows[:13]
    ]
    frames, truth = frames_at(simulated, [7]), simulated.dolp[13, 30:90, 45:135]
    frames = frames._replace(stokes=frames.stokes[..., 30:90, 45:135], valid=frames.valid[..., 30:90, 45:135])
    errors = {}
    for name, changes in (("ours", {}), ("registered", {}), ("registered", {"frames": frames})):
        recoverer = open_shipped(name, **changes)
        state, _ = recoverer.step(recoverer.start(60, 90), part[:12])
        _, prediction = recoverer.step(state, part[12:])
        assert prediction.dolp.shape == (1, 60, 90)
        errors[name, *changes] = (prediction.dolp[0] - truth).square().mean()
    assert errors["registered", "frames"] < errors["registered",] < errors["ours",]


@pytest.mark.parametrize("case", ["one window", "few windows", "no motion"])
def test_the_networks_own_maps_stay_where_there_is_nothing_to_register(case, windows, open_shipped):
    still = [EventWindow(windows[0].channels, 33_333 * k, 33_333 * (k + 1)) for k in range(10)]
    given = {"one window": windows[:1], "few windows": windows[:7], "no motion": still}[case]
    maps = []
    for name in ("ours", "registered"):
        recoverer = open_shipped(name)
        state = recoverer.start(120, 180)
        for window in given if case == "one window" else [given]:
            state, prediction = recoverer.step(state, [window] if case == "one window" else window)
        maps.append(prediction.dolp)
    torch.testing.assert_close(*maps, atol=1e-5, rtol=0)


def frames_at(simulated, places):
    """Frames that show the true polarization of these windows' ends, but for one corner."""
    dolp, aolp = (field[torch.tensor(places)] for field in (simulated.dolp, simulated.aolp))
    valid = torch.ones_like(dolp, dtype=torch.bool)
    valid[:, :20, :20] = False
    stokes = torch.stack([dolp * torch.cos(2 * aolp), dolp * torch.sin(2 * aolp)], dim=1)
    stokes[:, :, :20, :20] = torch.nan
    return StokesFrames(simulated.t_us.numpy()[places], stokes.float(), valid)


@pytest.mark.thorough
def test_what_frames_show_is_carried_along_the_motion_and_frames_of_another_time_change_nothing(
    simulated, windows, open_shipped
):
    frames = frames_at(simulated, [3, 15, 27])
    maps = {}
    for name, given in (("none", None), ("frames", frames), ("of another time", frames.since(2_000_000))):
        recoverer = open_shipped("registered", frames=given)
        maps[name] = recoverer.step(recoverer.start(120, 180), windows)[1]
    assert torch.equal(maps["none"].dolp, maps["of another time"].dolp)
    dolp, aolp = simulated.dolp[1:], simulated.aolp[1:]
    errors = {name: (maps[name].dolp - dolp).square().mean() for name in ("none", "frames")}
    assert errors["frames"] < 0.25 * errors["none"]
    turned = torch.remainder(maps["frames"].aolp - aolp + torch.pi / 2, torch.pi) - torch.pi / 2
    assert turned[dolp > 0.2].abs().mean() < 0.1
    assert maps["frames"].log_variance.exp().mean() < 0.5 * maps["none"].log_variance.exp().mean()


@pytest.mark.thorough
@pytest.mark.parametrize("with_frames", [False, True])
def test_maps_between_the_ends_of_windows_are_as_good_as_those_at_the_ends(simulated, open_shipped, with_frames):
    ends, middles = simulated.t_us[::2], simulated.t_us[1::2]
    windows = [
        EventWindow([slice_time(events, *span) for events in simulated.events], *span) for span in windows_of(ends)
    ]
    recoverer = open_shipped("registered", frames=frames_at(simulated, [3, 15, 27]) if with_frames else None)
    state, prediction = recoverer.step(recoverer.start(120, 180), windows)
    for at_end, again in zip(prediction, recoverer.between(state, ends[1:].numpy()), strict=True):
        assert at_end is again is None or torch.equal(at_end, again)
    between = recoverer.between(state, middles.numpy())
    at_ends, at_middles = (
        (maps.dolp - simulated.dolp[first::2])[2:].square().mean() for maps, first in ((prediction, 2), (between, 1))
    )
    assert at_middles < 1.1 * at_ends


def test_frames_of_a_camera_at_rest_are_averaged_where_nothing_happens_and_else_the_nearest_counts(
    simulated, windows, open_shipped
):
    nothing = [slice_time(events, 0, 0) for events in windows[0].channels]
    corner = [select(events, (events.x >= 150) & (events.y >= 90)) for events in windows[0].channels]
    still = [EventWindow(corner if k else nothing, 33_333 * k, 33_333 * (k + 1)) for k in range(10)]
    frames = frames_at(simulated, [2, 8])
    recoverer = open_shipped("registered", frames=frames)
    _, prediction = recoverer.step(recoverer.start(120, 180), still)
    mean, last = frames.stokes.mean(0), frames.stokes[1]
    torch.testing.assert_close(prediction.stokes[9, :, 30:70, 30:100], mean[:, 30:70, 30:100], atol=1e-4, rtol=0)
    torch.testing.assert_close(prediction.stokes[9, :, 110:, 170:], last[:, 110:, 170:], atol=1e-4, rtol=0)
    assert prediction.dolp.isfinite().all()
