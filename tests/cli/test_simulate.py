"""`polarnet simulate` gives the events of the Python call, in every format, and refuses what it cannot use."""

import itertools
import re
from dataclasses import replace

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import torch
import zarr
from filelock import FileLock

from polarnet.cli import main, simulated_files
from polarnet.clips import simulate_video, video
from polarnet.events.stream import Events, split_mosaic
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import fit, read_rgb
from polarnet.pictures.polarimetry import demosaic
from polarnet.recordings.recording import read_recording
from polarnet.simulation import MOTIONS, POLARIZERS, SENSORS, Camera, scene_from_intensities, scene_from_light, simulate
from polarnet.simulation.camera import PERFECT
from polarnet.simulation.upsampling import StokesFrame
from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic
from polarnet.storage.events import EventStore

HEIGHT, WIDTH, FRAMES = 24, 32, 6
MOSAIC = "90 45 / 135 0"
T_US = [0, 33_333, 66_667, 100_000, 133_333, 166_667]
SMALL = ["synthesize.sensor_height=20", "synthesize.sensor_width=30", "synthesize.duration_s=0.1",
         "ingest.height=60", "ingest.width=90", "synthesize.acceleration_max_px_s2=8000", "benchmark.lpips=false",
         "train.crop=null", "baselines.e2v.crop=null", "baselines.e2p.crop=null", "loss.lpips=0",
         "baselines.e2v.lpips=0", "baselines.e2p.lpips=0", "baselines.e2p.intensity_lpips=0"]  # fmt: skip
MOTION = replace(MOTIONS["default"], sensor_height=20, sensor_width=30, duration_s=0.1, acceleration_max_px_s2=8000.0)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def scenery(channels: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Frames (n, h, w, channels) of 8 bits: a pattern that moves by a pixel a frame."""
    rng = np.random.default_rng(channels)
    coarse = rng.integers(10, 120, (8, 10, channels), dtype=np.uint8)
    large = cv2.resize(coarse, (width + FRAMES, height + FRAMES), interpolation=cv2.INTER_CUBIC)
    large = large.reshape(*large.shape[:2], channels)
    return np.stack([large[k : k + height, k : k + width] for k in range(FRAMES)])


def write_video(path, frames: np.ndarray) -> None:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, frames.shape[2:0:-1])
    for frame in frames:
        video.write(np.ascontiguousarray(np.broadcast_to(frame, (*frame.shape[:2], 3))))
    video.release()


def decoded(path) -> np.ndarray:
    """Frames (n, h, w, 3) of a video, blue first."""
    read = cv2.VideoCapture(str(path)).read
    return np.stack([frame for _, frame in iter(read, (False, None))])


def write_folder(folder, frames: np.ndarray, suffix: str = "") -> None:
    folder.mkdir(exist_ok=True)
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"frame{k}{suffix}.png"), frame)


def rgb(frames: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(f[..., ::-1].transpose(2, 0, 1))).float() / 255 for f in frames]


def scenes(intensities: np.ndarray) -> list:
    """Scenes from 8-bit levels (n, 4, h, w), at 0, 45, 90 and 135 degrees."""
    return [scene_from_intensities(torch.from_numpy((frame / 510).astype(np.float32))) for frame in intensities]


def stored(out="out") -> list[Events]:
    store = EventStore.open(f"{out}/events.zarr")
    return store.read(store.sequences[0])


def assert_equal(got, expected) -> None:
    assert sum(map(len, expected)) > 100
    for one, other in zip(got, expected, strict=True):
        assert (one.height, one.width) == (other.height, other.width)
        assert all(torch.equal(getattr(one, name), getattr(other, name)) for name in "txyp")


def test_a_photograph_gives_the_events_and_the_truth_of_simulate(tmp_path):
    cv2.imwrite("lake.png", scenery(3, 80, 110)[0])
    assert main(["simulate", "lake.png", *SMALL, "--out", "out", "seed=4"]) == 0
    picture = torch.from_numpy(
        fit(read_rgb("lake.png").permute(1, 2, 0).numpy(), 60, 90, 1.0).transpose(2, 0, 1).copy()
    )
    result = simulate(picture, MOTION, SENSORS["default"], seed=4)
    assert_equal(stored(), result.events)
    truth = zarr.open_group("out/truth.zarr", mode="r")
    assert truth["t_us"][:].tolist() == result.t_us.tolist()
    np.testing.assert_allclose(truth["dolp"][:] / 65535, result.dolp, atol=1e-5)
    turned = np.abs(truth["aolp"][:] * np.pi / 65536 - result.aolp.numpy())
    assert np.minimum(turned, np.pi - turned).max() < 1e-4
    np.testing.assert_allclose(truth["s0"][:] / 65535, result.intensities[:, ::2].sum(1), atol=2e-5)


def test_the_dynamic_range_stretches_photographs_and_leaves_the_light_of_an_exr():
    motion, sensor = replace(MOTION, dynamic_range=1000.0), replace(SENSORS["clean"], dark_dn=0.0)
    options = [*SMALL, "--out", "out", "sensor=clean", "emulate.dark_dn=0.0", "synthesize.dynamic_range=1000.0"]
    photograph = scenery(3, 60, 90)[0]
    cv2.imwrite("lake.png", photograph)
    assert main(["simulate", "lake.png", *options]) == 0
    assert_equal(stored(), simulate(rgb(photograph[None])[0], motion, sensor, seed=1).events)
    light = (10 ** (photograph / 20 - 6)).astype(np.float32)
    assert oiio.ImageBuf(2**23 * light).write("lake.exr")  # its scale is free, as in cd/m²
    assert main(["simulate", "lake.exr", *options]) == 0
    scene = scene_from_light(torch.from_numpy(light / light.max()).permute(2, 0, 1).contiguous())
    assert_equal(stored(), simulate(scene, MOTION, sensor, seed=1).events)


def test_one_measurement_of_polarization_is_a_scene_under_a_moving_sensor():
    levels = scenery(4, 60, 90)[0].transpose(2, 0, 1)
    np.savez("lake.npz", **dict(zip(("I0", "I45", "I90", "I135"), levels, strict=True)))
    assert main(["simulate", "lake.npz", *SMALL, "--out", "out", "sensor=clean"]) == 0
    (scene,) = scenes(levels[None])
    assert_equal(stored(), simulate(scene, MOTION, SENSORS["clean"], seed=1).events)


def test_an_mp4_gives_the_events_of_its_frames_at_its_own_times_and_all_channels_see_the_same_grey(capsys):
    write_video("walk.mp4", scenery(3))
    assert main(["simulate", "walk.mp4", "--out", "out", "sensor=noisy", "seed=7"]) == 0
    assert_equal(stored(), simulate_video(rgb(decoded("walk.mp4")), T_US, SENSORS["noisy"], seed=7).events)
    assert "0.167 s, 6 true frames" in capsys.readouterr().out
    preview = cv2.VideoCapture("out/preview.mp4")
    assert preview.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES - 1
    assert main(["simulate", "walk.mp4", "--out", "out", "sensor=clean", "--grey", "--no-preview",
                 "emulate.contrast_threshold_sigma_on=0", "emulate.contrast_threshold_sigma_off=0"]) == 0  # fmt: skip
    first, *others = stored()
    assert_equal([first] * 3, others)
    assert "DoLP is 0 everywhere" in capsys.readouterr().out


def test_a_folder_of_frames_has_the_times_of_its_rate_or_of_a_file_and_the_order_of_its_numbers(tmp_path):
    frames = np.concatenate([scenery(3), scenery(3)[::-1]])  # frame10 comes after frame9
    write_folder(tmp_path / "walk", frames)
    times = np.cumsum([0.5, *[0.004, 0.006] * 5, 0.01])
    (tmp_path / "times.txt").write_text("# s\n" + "".join(f"{t:.3f} frame{k}\n" for k, t in enumerate(times)))
    (tmp_path / "walk" / "timestamps.txt").write_text("".join(f"{1000 * k + k % 2}\n" for k in range(12)))
    for given, t_us in (
        (["--fps", "250"], [4000 * k for k in range(12)]),
        (["--times", "times.txt", "--time-unit", "s"], [round(1e6 * (t - 0.5)) for t in times]),
        ([], [1000 * k + k % 2 for k in range(12)]),
    ):
        assert main(["simulate", "walk", "--out", "out", *given, "--no-preview"]) == 0
        assert_equal(stored(), simulate_video(rgb(frames), t_us, SENSORS["default"], seed=1).events)


def test_four_angles_give_the_events_of_the_measured_scenes(tmp_path):
    frames = scenery(4).transpose(0, 3, 1, 2)
    for k, angle in enumerate(POLARIZER_ANGLES_DEG):
        write_folder(tmp_path / "walk", frames[:, k], f"_{angle}")
    assert main(["simulate", "walk", "--fps", "30", "--out", "out"]) == 0
    assert_equal(stored(), simulate_video(scenes(frames), T_US, SENSORS["default"], seed=1).events)


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_raw_mosaics_give_the_events_of_the_demosaicked_scenes(tmp_path, kind):
    frames = scenery(1)
    if kind == "video":
        write_video("walk.mp4", frames)
        frames, given = decoded("walk.mp4")[..., 1], ["walk.mp4"]
    else:
        write_folder(tmp_path / "walk", frames)
        frames, given = frames[..., 0], ["walk", "--fps", "30"]
    assert main(["simulate", *given, "--out", "out", "--mosaic", MOSAIC]) == 0
    angles = np.stack([demosaic(frame.astype(np.float64), parse_mosaic(MOSAIC)) for frame in frames])
    expected = simulate_video(scenes(angles), T_US, SENSORS["default"], seed=1).events
    assert (expected[0].height, expected[0].width) == (10, 14)
    assert_equal(stored(), expected)


def test_sizes_polarizers_readout_and_upsampling_are_those_of_the_python_call():
    write_video("walk.mp4", scenery(3, 32, 40))
    settings = ["polarizers=micropolarizers", "readout.max_events_per_s=300000"]
    assert main(["simulate", "walk.mp4", "--size", "20", "30", "--out", "out", "--upsample", *settings]) == 0
    frames = [frame.permute(1, 2, 0).numpy() for frame in rgb(decoded("walk.mp4"))]
    small = [torch.from_numpy(fit(frame, 20, 30, 1.0).transpose(2, 0, 1).copy()) for frame in frames]
    readout = replace(PERFECT, max_events_per_s=300_000.0, max_wait_us=1000.0)
    camera = Camera(SENSORS["default"], POLARIZERS["micropolarizers"], readout)
    expected = simulate_video(small, T_US, camera, seed=1, upsample=True).events
    assert (expected[0].height, expected[0].width) == (10, 15)
    assert_equal(stored(), expected)
    assert zarr.open_group("out/truth.zarr", mode="r")["t_us"][:].tolist() == T_US


@pytest.mark.thorough
@pytest.mark.parametrize(("form", "suffix"), [("hdf5", "h5"), ("text", "txt"), ("evt3", "raw")])
def test_files_for_other_tools_read_back_equal_one_a_sensor(form, suffix, capsys):
    write_video("walk.mp4", scenery(3))
    for layout in ("four_sensors", "dofp"):
        given = ["--to", "store", form, f"polarizers.layout={layout}", "--no-preview", "seed=1"]
        assert main(["simulate", "walk.mp4", "--out", layout, *given]) == 0
    files = [f"four_sensors/polarizer_{angle:03d}.{suffix}" for angle in POLARIZER_ANGLES_DEG]
    assert_equal([read_recording(file).events for file in files], stored("four_sensors"))
    sensor = read_recording(f"dofp/sensor.{suffix}").events
    assert_equal(split_mosaic(sensor, parse_mosaic(MOSAIC)), stored("dofp"))
    capsys.readouterr()
    assert main(["inspect", f"dofp/sensor.{suffix}"]) == 0
    assert f"{sum(map(len, stored('dofp'))):,}" in capsys.readouterr().out


def test_interrupted_or_failed_runs_leave_an_earlier_run_and_nothing_else(tmp_path, monkeypatch, capsys):
    write_video("walk.mp4", scenery(3))
    command = ["simulate", "walk.mp4", "--out", "out", "--no-preview"]
    assert main(command) == 0
    before = stored()

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulated_files, "leave_sensors", interrupted)
    assert main([*command, "seed=2"]) == 130
    assert capsys.readouterr().err.endswith(
        "polarnet simulate: stopped; finished work is kept, and the same command again continues from it\n"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "walk.mp4"]
    assert_equal(stored(), before)
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert main([*command, "seed=2"]) == 0
    assert not torch.equal(stored()[0].t, before[0].t)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of usable and unusable inputs."""
    folder = tmp_path_factory.mktemp("inputs")
    for name in ("empty", "mine", "store"):
        (folder / name).mkdir()
    write_folder(folder / "walk", scenery(3))
    write_folder(folder / "mixed", scenery(3))
    write_folder(folder / "odd", scenery(1, 23, 32))
    for path, size in (("mixed/frame3.png", (26, 32)), ("lake.png", (80, 110))):
        cv2.imwrite(str(folder / path), scenery(3, *size)[0])
    write_video(folder / "walk.mp4", scenery(3))
    texts = {"broken.mp4": "no video", "broken.png": "no picture", "mine/notes.txt": "keep", "soon.txt": "0\nsoon\n"}
    texts |= {f"{count}.txt": "\n".join(map(str, range(0, 10 * count, 10))) for count in (5, 7)}
    for name, text in (texts | {"s.txt": "0\n0.1\n0.2\n0.3\n0.4\n0.5\n", "store/zarr.json": "{}"}).items():
        (folder / name).write_text(text)
    return folder


FPS = ["--fps", "30"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent.mp4"], "there is no such file"),
        (["broken.mp4"], "cannot open it as a video; convert it to MP4"),
        (["broken.png"], "cannot be read"),
        (["empty", *FPS], "expected the pictures of a clip, found none"),
        (["store"], "store: expected a picture, a video or a folder of frames, got a store"),
        (["walk"], "give --fps HZ, --times FILE"),
        (["walk", "--times", "5.txt"], "expected a time for each of 6 frames, got 5"),
        (["walk.mp4", "--times", "7.txt"], "expected a time for each of 6 frames, got 7"),
        (["walk", "--times", "s.txt"], "name the unit with --time-unit"),
        (["walk", "--times", "soon.txt"], "line 2: expected a time in us, got 'soon'"),
        (["mixed", *FPS], "frame3.png: expected frames of one size, got 26x32 px after frame0.png of 24x32 px"),
        (["odd", *FPS, "--mosaic", MOSAIC], "even height and width"),
        (["odd", *FPS, "polarizers.layout=dofp"], "even sides"),
        (["walk.mp4", "walk"], "expected one picture, video or folder of frames before KEY=VALUE, got 2"),
        (["lake.png", *FPS, "--upsample"], "expected no --fps, --upsample"),
        (["walk.mp4", "--to", "aedat"], "expected some of store, hdf5, text, evt3, got aedat"),
        (["walk.mp4", "--white", "100"], "expected no --white"),
        (["walk.mp4", "--size", "48", "64"], "--size: expected at most the frames' 24 32"),
        (["walk.mp4", "emulate.contrast=1"], "emulate.contrast"),
        (["walk.mp4", "--out", "mine"], "`polarnet simulate` did not write"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_words(inputs, monkeypatch, capsys, words, message):
    monkeypatch.chdir(inputs)
    assert main(["simulate", "--out", "out", *words]) == 1
    error = capsys.readouterr().err
    assert message in error.splitlines()[-1]
    assert "Traceback" not in error
    assert not (inputs / "out").exists()


def test_levels_above_the_first_frames_bits_are_refused_and_white_names_the_level(tmp_path, capsys):
    levels = scenery(4).transpose(0, 3, 1, 2).astype(np.uint16) * 4
    levels[3:] *= 4
    for k, angle in enumerate(POLARIZER_ANGLES_DEG):
        write_folder(tmp_path / "walk", levels[:, k], f"_{angle}")
    assert main(["simulate", "walk", "--fps", "30"]) == 1
    assert "frame 3: expected levels up to 1023" in capsys.readouterr().err
    assert main(["simulate", "walk", "--fps", "30", "--white", "4095", "--out", "out"]) == 0
    expected = [scene_from_intensities(torch.from_numpy((f / 8190).astype(np.float32))) for f in levels]
    assert_equal(stored(), simulate_video(expected, T_US, SENSORS["default"], seed=1).events)


def test_a_long_clip_does_not_stay_in_memory(monkeypatch):
    """Frames are read a piece at a time."""
    monkeypatch.setattr(video, "PIECE_PIXELS", 4 * HEIGHT * WIDTH)
    read = []

    def frames():
        for k in itertools.count():
            read.append(k)
            yield StokesFrame(1000 * k, torch.full((3, HEIGHT, WIDTH), 0.1) * torch.tensor([1.0, 0, 0]).view(3, 1, 1))

    pieces = video.video_pieces(frames(), Camera(SENSORS["clean"]), seed=1)
    for k in range(1, 4):
        assert next(pieces).stop_us == 1000 * (4 * k - 1)
        assert len(read) == 4 * k


def test_demo_recovers_a_photograph_better_than_its_mean(tmp_path, capsys):
    size = ["synthesize.sensor_height=60", "synthesize.sensor_width=90", "synthesize.duration_s=0.4"]
    rest = [word for word in SMALL if not word.startswith(("synthesize.", "ingest."))]
    assert main(["demo", "--out", str(tmp_path / "demo"), *size, *rest]) == 0
    printed = capsys.readouterr().out
    assert f"open {tmp_path / 'demo' / 'recovered' / 'index.html'}" in printed
    assert (scores := re.search(r"^scores +(MSE .*)$", printed, re.MULTILINE))
    assert scores[1] in (tmp_path / "demo" / "recovered" / "index.html").read_text()
    assert (tmp_path / "demo" / "recovered" / "recovered.mp4").stat().st_size > 10_000
    truth = np.asarray(zarr.open_group(tmp_path / "demo" / "simulated" / "truth.zarr", mode="r")["dolp"]) / 65535
    dolp = np.asarray(zarr.open_group(tmp_path / "demo" / "recovered" / "recovered.zarr", mode="r")["dolp"]) / 65535
    error = np.square(dolp[5:] - truth[6:]).mean(axis=(1, 2))
    assert len(dolp) == len(truth) - 1
    assert error.mean() < truth[6:].var(axis=(1, 2)).mean()


@pytest.mark.parametrize("command", [["demo"], ["simulate", str(BUILTIN_PHOTOS[0].path)]], ids=lambda words: words[0])
def test_a_command_is_refused_where_another_process_writes(command, tmp_path, capsys):
    with FileLock(tmp_path / "out.lock.tmp"):
        assert main([*command, "--out", str(tmp_path / "out"), *SMALL]) == 1
    assert f"{tmp_path / 'out'}: another process is writing it" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
