"""From a picture in memory to events and truth, and the page that shows how."""

import contextlib
import io
import re
import subprocess
import sys
from dataclasses import asdict, replace

import pytest
import torch

import polarnet.simulation
from polarnet.config import load
from polarnet.events.stream import validate
from polarnet.simulation import MOTIONS, SENSORS, scene_from_rgb, simulate
from polarnet.stokes import dolp, stokes_from_intensities

MOTION = replace(MOTIONS["default"], window_height=20, window_width=30, duration_s=0.2, acceleration_max_px_s2=4000.0)


def picture() -> torch.Tensor:
    coarse = torch.rand(1, 3, 9, 12, generator=torch.Generator().manual_seed(2))
    return torch.nn.functional.interpolate(coarse, (72, 96), mode="bilinear")[0]


def test_the_truth_belongs_to_the_events_and_the_light_to_the_truth():
    result = simulate(picture(), MOTION, SENSORS["default"], seed=3)
    assert result.t_us.tolist() == [0, 33333, 66667, 100000, 133333, 166667, 200000]
    assert result.intensities.shape == (7, 4, 20, 30)
    torch.testing.assert_close(dolp(stokes_from_intensities(result.intensities)), result.dolp, atol=2e-3, rtol=0)
    for events in result.events:
        validate(events)
        assert len(events) > 100
        assert 0 <= events.t[0] <= events.t[-1] <= result.t_us[-1]


def test_a_seed_gives_the_same_events_again_and_another_seed_others():
    first, again, other = (simulate(picture(), MOTION, SENSORS["noisy"], seed) for seed in (1, 1, 2))
    assert all(torch.equal(a.t, b.t) for a, b in zip(first.events, again.events, strict=True))
    assert first.trajectory != other.trajectory


def test_a_scene_gives_what_its_picture_gives():
    from_picture = simulate(picture(), MOTION, SENSORS["clean"], seed=1)
    from_scene = simulate(scene_from_rgb(picture()), MOTION, SENSORS["clean"], seed=1)
    assert all(torch.equal(a.t, b.t) for a, b in zip(from_picture.events, from_scene.events, strict=True))


def test_the_default_presets_are_what_params_yaml_says(project_root):
    config = load(project_root)
    assert asdict(SENSORS["default"]) == asdict(config.emulate)
    assert asdict(MOTIONS["default"]) == asdict(config.synthesize)


@pytest.mark.parametrize("name", list(SENSORS))
def test_the_sensors_are_those_of_the_configuration(project_root, name):
    assert asdict(SENSORS[name]) == asdict(load(project_root, [f"sensor={name}"]).emulate)


def test_every_public_name_is_there_and_no_other():
    for name in polarnet.simulation.__all__:
        assert getattr(polarnet.simulation, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        polarnet.simulation.nothing  # noqa: B018


def test_importing_the_package_loads_nothing_heavy():
    script = "import sys, polarnet.simulation; print(sorted({'torch', 'numba', 'zarr', 'cv2'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_lines_on_the_page_run_as_they_stand(project_root):
    page = (project_root / "docs" / "simulation.md").read_text()
    snippet = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert snippet is not None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(snippet[1], {})
    counts = [int(word) for word in re.findall(r"\d+", printed.getvalue())]
    assert len(counts) == 4
    assert min(counts) > 10_000
