import numpy as np
import pytest
import torch

from polarnet.events.representations import event_counts
from polarnet.events.streaming import encode_windows
from polarnet.simulation import MOTIONS, SENSORS, scene_from_polarization, simulate
from studies.registration import contrasts, redundant_offset, register


@pytest.fixture(scope="module")
def simulated():
    """A second of a sensor that moves over smooth random light of random polarization."""
    generator = torch.Generator().manual_seed(3)
    planes = torch.nn.functional.interpolate(
        torch.rand(1, 3, 60, 90, generator=generator), (240, 360), mode="bicubic"
    ).clamp(0.02, 0.98)[0]
    scene = scene_from_polarization(planes[0], 0.7 * planes[1], 3.1 * planes[2])
    return simulate(scene, MOTIONS["default"], SENSORS["clean"], seed=1)


def test_motion_and_contrasts_of_a_moving_scene_are_found(simulated):
    counts = encode_windows(simulated.events, simulated.t_us, event_counts).numpy()
    polarity, number = counts[:, 0::2].transpose(1, 0, 2, 3), counts[:, 1::2].transpose(1, 0, 2, 3)
    panorama = register(np.stack([number + polarity, number - polarity], axis=1) / 2)

    pose = simulated.trajectory.pose(simulated.t_us.numpy() * 1e-6)
    for found, true in ((panorama.x, pose.x), (panorama.y, pose.y)):
        assert np.std(found - true) < 0.3

    dolp, aolp = (field[6:].numpy() for field in (simulated.dolp, simulated.aolp))
    truth = np.arctanh(dolp * np.stack([np.cos(2 * aolp), np.sin(2 * aolp)]))
    found = contrasts(panorama, (120, 180), 6)
    for one, true in zip(found, truth, strict=True):
        assert np.corrcoef(one.ravel(), true.ravel())[0, 1] > 0.9
    offset = np.median(truth - found, axis=(1, 2, 3))
    assert redundant_offset(panorama) == pytest.approx(offset, abs=0.06)
