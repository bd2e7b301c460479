import io
import itertools
import re

import numpy as np
import pytest
import torch
import zarr
from event_fixtures import random_events

from polarnet.cli import main
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import load
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow, WindowRule
from polarnet.methods import METHODS
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks import load_network, shipped_weights
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.live import live_lines, replay
from polarnet.recovery.inputs import open_channels
from polarnet.recovery.stream import frames_of, open_method
from polarnet.runtime import machine as runtime
from polarnet.storage.events import EventStore

HEIGHT, WIDTH, DURATION_US, ANGLES = 16, 20, 100_000, (0, 45, 90, 135)


@pytest.fixture
def weights(checkpoints):
    return checkpoints["paper"]


def write_lines(path, events):
    table = np.stack([getattr(events, name).numpy().astype(np.int64) for name in "txyp"], axis=1)
    path.write_bytes(f"{events.width} {events.height}\n".encode() + lines_of(table, " "))
    return path


def opened(store):
    return open_channels([store], sequence="lake")


def recovered(out):
    group = zarr.open_group(out / "recovered.zarr", mode="r")
    return {name: group[name][:] for name in ("t_us", "dolp")}


def run(*arguments, out):
    return main(["recover", *map(str, arguments), "--out", str(out), "--write", "zarr"])


def test_a_store_four_files_and_lines_that_come_give_the_same(store, channels, weights, tmp_path, monkeypatch, capsys):
    options = ("--weights", weights, "--window", "20ms", "--device", "cpu")
    assert run(store, "--sequence", "road", *options, out=tmp_path / "a") == 0
    printed = capsys.readouterr().out
    assert re.search(r"frames +5 of 0\.100 s", printed)
    assert "times as fast as real time" in printed
    files = [write_lines(tmp_path / f"{angle}.txt", channels[angle // 45]) for angle in (90, 0, 135, 45)]
    assert run(*files, "--angles", 90, 0, 135, 45, *options, out=tmp_path / "b") == 0
    head, _, lines = live_lines(channels)
    live = tmp_path / "live.txt"
    live.write_bytes(head + lines + f"{DURATION_US} 0 0 1 0\n".encode())
    assert run(live, "--live", "--idle", 0, *options, out=tmp_path / "c") == 0
    assert re.search(r"latency +[\d.]+ ms \(median\)", capsys.readouterr().out)
    expected = recovered(tmp_path / "a")
    assert expected["t_us"].tolist() == [20_000, 40_000, 60_000, 80_000, 100_000]
    for other in "bc":
        frames = recovered(tmp_path / other)
        assert frames["t_us"].tolist() == expected["t_us"].tolist()
        np.testing.assert_allclose(frames["dolp"].astype(float), expected["dolp"], atol=3)


def test_bfloat16_is_used_where_there_are_units_for_it(store, weights, tmp_path, monkeypatch, capsys):
    def dolp(asked, units, taken):
        monkeypatch.setattr(runtime, "bf16_units", lambda device: units)
        options = ("--sequence", "lake", "--weights", weights, "--device", "cpu", "--precision", asked)
        assert run(store, *options, out=tmp_path / "out") == 0
        assert f"network paper ({taken})" in capsys.readouterr().out
        return recovered(tmp_path / "out")["dolp"]

    fp32, bf16 = dolp("fp32", ["AMX"], "fp32"), dolp("bf16", [], "bf16")
    assert not np.array_equal(fp32, bf16)
    assert np.array_equal(dolp("auto", [], "fp32"), fp32)
    assert np.array_equal(dolp("auto", ["AMX"], "bf16"), bf16)


def test_the_lines_on_the_page_run_as_they_stand(store, channels, weights, project_root):
    snippet = re.search(r"```python\n(.*?)```", (project_root / "docs" / "recover.md").read_text(), re.DOTALL)
    assert snippet is not None
    camera = [
        ([slice_time(events, begin, begin + 50_000) for events in channels], begin + 50_000)
        for begin in range(0, DURATION_US, 50_000)
    ]
    names = {"path": weights, "height": HEIGHT, "width": WIDTH, "camera": camera}
    exec(snippet[1], names)
    *_, last = frames_of(opened(store), WindowRule(33_333, None), dolp_recoverer(*load_network(weights)))
    torch.testing.assert_close(names["prediction"].dolp[0], last.prediction.dolp, atol=1e-5, rtol=1e-4)


@pytest.mark.thorough
def test_windows_that_overlap_give_a_frame_every_tenth_of_a_millisecond(store, weights):
    source = opened(store)
    frames = list(frames_of(source, WindowRule(33_333, 100), dolp_recoverer(*load_network(weights))))
    ends = [frame.window.stop_us for frame in frames]
    assert ends == list(range(33_333, DURATION_US + 1, 100))
    change = torch.stack([frame.prediction.dolp for frame in frames]).diff(dim=0).abs().mean(dim=(1, 2))
    assert change.max() < 0.05


def test_a_file_goes_through_the_network_several_windows_at_once_and_gives_the_same(store, weights):
    rule, source = WindowRule(20_000, None), opened(store)
    recoverer = dolp_recoverer(*load_network(weights))
    runs = (recoverer._replace(at_once=lambda height, width, n=n: n) for n in (1, 2))
    by_one, by_two = (list(frames_of(source, rule, one)) for one in runs)
    assert [frame.window.stop_us for frame in by_two] == [20_000, 40_000, 60_000, 80_000, 100_000]
    assert [frame.step_s == after.step_s for frame, after in itertools.pairwise(by_two)] == [True, False, True, False]
    for one, other in zip(by_one, by_two, strict=True):
        torch.testing.assert_close(one.prediction.dolp, other.prediction.dolp, atol=1e-5, rtol=1e-4)


def test_a_sequence_ends_with_its_last_event_and_is_replayed_as_lines(store, channels):
    *_, last = opened(store).pieces
    assert last.until_us == DURATION_US
    head, _, lines = live_lines(channels)
    out = io.BytesIO()
    replay(channels, 1000.0, out.write)
    assert out.getvalue() == head + lines


@pytest.mark.parametrize(("arguments", "reason"), [
    ((), "--sequence: expected a sequence of lake, road; got None"),
    (("--sequence", "lake", "--method", "oracle_mean"), "expected a method of cf"),
    (("--sequence", "lake", "--method", "e2vid_published"),
     "no weights are given: add the row to section `rows` of params.yaml, with their file as "
     "rows.e2vid_published.needs; or name the file with --weights"),
    (("--sequence", "lake", "--method", "cf", "--window", "1s"),
     "events.zarr lasts 100 ms, less than one window of 1000 ms: record for longer, or give --window 33.333ms"),
    (("--sequence", "lake", "--method", "cf", "--step", "9ev"), "expected a time such as 0.1ms"),
    (("--sequence", "lake", "--method", "cf", "--step", "1s"), "events between windows would be lost"),
    (("--sequence", "lake", "--method", "cf", "--device", "cuda:9"), "sees no GPU"),
    (("--sequence", "lake", "--weights", "nothing.safetensors"), "nothing.safetensors: there is no such file"),
    (("--live", "--method", "cf", "--height", 70), "--live: expected no --height"),
    (("--sequence", "lake", "--method", "cf", "--height", 8), "an event store: expected no --height"),
    (("--mosaic", "90 45 / 135 0"), "an event store: expected no --mosaic, which does not apply to this input"),
    (("--sequence", "lake", "--angles", 0, 45, 90, 135), "one arrangement of polarizers, got --angles, --sequence"),
])  # fmt: skip
def test_what_cannot_work_says_why(arguments, reason, store, tmp_path, at_root, capsys):
    if "cuda:9" in arguments and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    method = () if {"--method", "--weights"} & set(arguments) else ("--method", "cf")
    assert run(store, *arguments, *method, out=tmp_path / "new" / "out") == 1
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_second_recovery_replaces_the_first_and_other_files_are_refused(store, tmp_path, at_root, capsys):
    out, arguments = tmp_path / "out", ("recover", str(store), "--sequence", "lake", "--method", "highpass")
    arguments = (*arguments, "--out", str(out), "--write")
    assert main([*arguments, "zarr", "mp4", "--window", "10ms"]) == 0
    assert len(recovered(out)["t_us"]) == 10
    assert main([*arguments, "zarr", "--window", "50ms"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["index.html", "recovered.png", "recovered.zarr", "run.json"]
    assert len(recovered(out)["t_us"]) == 2
    assert f"page        {out / 'index.html'}" in capsys.readouterr().out
    assert main([*arguments, "zarr", "--window", "1s"]) == 1
    assert len(recovered(out)["t_us"]) == 2
    (tmp_path / "out" / "run.json").unlink()
    assert main([*arguments, "zarr", "--window", "50ms"]) == 1
    assert "contains files that `polarnet recover` did not write; name another folder" in capsys.readouterr().err


def test_a_mosaic_without_polarizers_is_named_on_the_terminal_and_on_the_page(tmp_path, at_root, capsys):
    """Every pixel fires at once in a random pattern of edges, whatever its place in a cell."""
    generator = np.random.default_rng(2)
    t = np.repeat(np.arange(0, 330_000, 1000), 60)
    cells = generator.integers(0, (40, 60), (len(t), 2))
    p = generator.choice([-1, 1], len(t))
    y, x, t, p = (np.repeat(values, 4) for values in (2 * cells[:, 0], 2 * cells[:, 1], t, p))
    y, x = y + np.tile([0, 0, 1, 1], len(cells)), x + np.tile([0, 1, 0, 1], len(cells))
    keep = generator.random(len(t)) < 0.9  # pixels do not fire alike to the last event
    columns = (t[keep], x[keep].astype(np.int16), y[keep].astype(np.int16), p[keep].astype(np.int8))
    camera = write_lines(tmp_path / "camera.txt", Events(*map(torch.from_numpy, columns), 80, 120))
    out = tmp_path / "out"
    assert run(camera, "--mosaic", "90 45 / 135 0", "--method", "highpass", out=out) == 0
    printed = capsys.readouterr()
    assert "warning: The four channels show the same" in printed.err
    assert re.search(r"events +[\d,]+ at 0, [\d,]+ at 45, [\d,]+ at 90, [\d,]+ at 135 degrees", printed.out)
    assert "was made without polarizers" in (out / "index.html").read_text()


def test_what_a_very_short_recording_is_told_works(channels, tmp_path, at_root, capsys):
    early = [slice_time(events, 0, 8000) for events in channels]
    files = [write_lines(tmp_path / f"{angle}.txt", e) for angle, e in zip(ANGLES, early, strict=True)]
    arguments = (*files, "--angles", *ANGLES, "--method", "highpass")
    assert run(*arguments, out=tmp_path / "out") == 1
    advice = re.search(
        r"record for longer, or give a filter, --method highpass --window (\d+us)", capsys.readouterr().err
    )
    assert advice is not None
    assert not (tmp_path / "out").exists()
    assert run(*arguments, "--window", advice[1], out=tmp_path / "out") == 0


def test_files_of_no_arrangement_are_refused(make_channel, tmp_path, at_root, capsys):
    one, picture = write_lines(tmp_path / "camera.txt", make_channel(1)), tmp_path / "lake.JPG"
    picture.touch()
    for files, reason in (
        ([one], "say where the polarizers of its pixels are"),
        ([one, one], "four files with --angles, got 2"),
        ([one] * 4, "say the polarizer of each"),
        ([one] * 4 + ["--angles", 0, 45, 90, 90], "one file for each of 0, 45, 90 and 135 degrees, got [0, 45, 90]"),
        ([one, "--angles", 0, 45, 90, 135], "four files with --angles, got 1"),
        ([one, "--mosaic", "90 45 / 135 0", "--angles", 0, 45, 90, 135], "got --angles, --mosaic"),
        ([one, "--live", "--sequence", "lake"], "--live: expected no --sequence"),
        ([one, one, "--live"], "--live: expected one input, got 2"),
        ([tmp_path / "none.csv"], "there is no such file"),
        ([picture], "lake.JPG is a picture, no recording: `polarnet simulate"),
    ):
        assert run(*files, "--method", "cf+gain", out=tmp_path / "out") == 1
        assert not (tmp_path / "out").exists()
        assert reason in capsys.readouterr().err


def test_the_shipped_network_takes_the_thresholds_of_the_camera_and_other_methods_do_not(project_root):
    config, highpass, ours = load(project_root, ["runtime.device=cpu"]), METHODS["highpass"], METHODS["ours"]
    for option, value in (("thresholds", (0.1, 0.1)), ("binning", 2)):
        with pytest.raises(ValueError, match=f"--{option} is for the DoLP network, highpass does not use it"):
            open_method(highpass, setup_of(config, highpass), settings={option: value})
    windows = [EventWindow([Events.empty(HEIGHT, WIDTH)] * 4, 0, 33_333)]
    recoverer, words = open_method(ours, setup_of(config, ours), settings={"thresholds": (0.1, 0.4)})
    assert words.endswith(str(shipped_weights()))
    assert recoverer.step(recoverer.start(HEIGHT, WIDTH), windows)[1].dolp.shape == (1, HEIGHT, WIDTH)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 20), (20, 1)])
def test_a_sensor_of_one_row_or_column_is_refused(height, width, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    store = EventStore.create("line.zarr", ["a"], height, width, {})
    store.write("a", [random_events(seed, 2000, 400_000, height, width) for seed in range(4)], 400_000)
    store.finish()
    assert main(["recover", "line.zarr", "--write", "zarr"]) == 1
    message = f"expected a sensor of at least 2x2 pixels behind each polarizer, got {height}x{width}"
    assert message in capsys.readouterr().err


@pytest.mark.thorough
def test_an_hour_of_live_input_with_a_wrong_clock_loses_the_events_that_the_warning_names(tmp_path, capsys, at_root):
    """Stale events, late ones, a wrong time, a pause of two minutes, a reset and a jump of two hours; 100 events/s."""
    minute_us = 60_000_000
    steady = np.arange(0, 60 * minute_us, 10_000)
    clock_us = steady + 10**9
    clock_us[steady >= 20 * minute_us] += 2 * minute_us  # the pause
    clock_us[steady >= 30 * minute_us] -= 10**9 + 32 * minute_us  # the reset, to 0
    clock_us[steady >= 45 * minute_us] += 120 * minute_us  # the jump
    wrong = {10: [10**15], 25: [*range(10**8, 10**8 + 20)], 40: [10**13 + 7]}
    places = np.repeat([minute * 6000 for minute in wrong], [len(times) for times in wrong.values()])
    t = np.insert(clock_us, places, np.concatenate([*wrong.values()]))
    t = np.concatenate([9 * 10**9 + np.arange(40), t])
    k = np.arange(len(t))
    table = np.stack([t, k % 8, k // 8 % 8, k // 64 % 2], axis=1)
    camera, out = tmp_path / "camera.txt", tmp_path / "out"
    camera.write_bytes(b"8 8\n" + lines_of(table, " "))
    options = ["--mosaic", "90 45 / 135 0", "--live", "--idle", "0", "--method", "highpass", "--window", "10s"]
    assert main(["recover", str(camera), *options, "--write", "zarr", "--out", str(out)]) == 0
    printed, warnings = capsys.readouterr()
    dropped = {"stale": 40, "time_glitches": sum(map(len, wrong.values()))}
    named = [int(number.replace(",", "")) for number in re.findall(r"camera\.txt: ([\d,]+) .*left out", warnings)]
    assert sorted(named) == sorted(dropped.values())
    counts = re.search(r"events +(.*) degrees", printed)
    assert counts is not None
    read = sum(int(number.replace(",", "")) for number in re.findall(r"([\d,]+) at", counts[1]))
    assert read == len(t) - sum(dropped.values())
    assert "2 times at which the clock of live input was set anew" in warnings
    group = zarr.open_group(out / "recovered.zarr", mode="r")
    last_us = 62 * minute_us - 10_000  # a reset and a jump continue after 10 ms, the step of these events
    assert group["t_us"][:].tolist() == list(range(10**7, last_us + 1, 10**7))
    assert np.isfinite(group["dolp"][:]).all()
