"""`polarnet convert`."""

import argparse
import re

import pytest
import torch
from event_fixtures import events_of

from polarnet.cli import main
from polarnet.cli.options import duration_us
from polarnet.recordings.recording import read_recording
from polarnet.recordings.writers import write_text

EVENTS = [(1_000_000, 3, 4, 1), (1_250_000, 5, 6, -1), (1_500_000, 0, 0, 1), (1_750_000, 7, 7, -1)]


@pytest.fixture
def recording(tmp_path):
    write_text(tmp_path / "in.txt", events_of(EVENTS, 8, 9))
    return tmp_path / "in.txt"


@pytest.mark.parametrize("name", ["out.h5", "out.txt", "out.raw"])
def test_all_events_arrive_in_every_format_with_time_0_at_the_first(recording, tmp_path, name, capsys):
    pytest.importorskip("h5py")
    assert main(["convert", str(recording), str(tmp_path / name)]) == 0
    events = read_recording(tmp_path / name).events
    assert (events.height, events.width) == (8, 9)
    rows = torch.stack([events.t, events.x.long(), events.y.long(), events.p.long()], 1).tolist()
    assert rows == [[t - 1_000_000, x, y, p] for t, x, y, p in EVENTS]
    assert "4 events, time 0 is 1000000 us" in capsys.readouterr().out


def test_a_span_is_half_open_and_counts_from_the_first_event(recording, tmp_path, capsys):
    out = tmp_path / "out.txt"
    assert main(["convert", str(recording), str(out), "--start", "250ms", "--stop", "0.75s"]) == 0
    assert read_recording(out).events.t.tolist() == [0, 250_000]
    assert "2 events, time 0 is 1250000 us" in capsys.readouterr().out
    assert main(["convert", str(recording), str(out), "--start", "1s", "--stop", "500ms"]) == 1
    assert "expected --stop after --start, got 1000000 to 500000 us" in capsys.readouterr().err
    assert main(["convert", str(recording), str(out), "--start", "1s"]) == 1
    assert "expected events between --start and --stop, there are none" in capsys.readouterr().err
    assert read_recording(out).events.t.tolist() == [0, 250_000]


@pytest.mark.parametrize(
    ("text", "us"), [("33.3ms", 33_300), ("100 us", 100), (".5s", 500_000), ("33", None), ("ms", None), ("-3ms", None)]
)
def test_a_time_has_a_unit(text, us):
    options = argparse.Namespace(stop=text)
    if us is not None:
        assert duration_us(options, "stop", "500ms") == us
        return
    with pytest.raises(ValueError, match=f"--stop: expected a time such as 500ms, got {text}"):
        duration_us(options, "stop", "500ms")


def test_what_cannot_be_converted_is_refused(recording, tmp_path, capsys):
    assert main(["convert", str(recording), str(tmp_path / "out.xyz")]) == 1
    assert "expected a suffix of .h5, .hdf5, .txt, .raw, or --to FORMAT" in capsys.readouterr().err
    assert main(["convert", str(recording), str(recording)]) == 1
    assert "expected another file than the one to convert" in capsys.readouterr().err
    for time in ("5ev", "100"):
        assert main(["convert", str(recording), str(tmp_path / "o.txt"), "--stop", time]) == 1
        assert f"--stop: expected a time such as 500ms, got {time}" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.txt"]


def test_the_parts_before_and_after_resets_of_the_clock_are_converted_as_advised(tmp_path, capsys):
    parts = range(5_000_000, 5_400_000, 1000), range(1000, 400_000, 1000), range(0, 50_000, 1000)
    source, out = tmp_path / "in.txt", tmp_path / "out.h5"
    source.write_text("8 9\n" + "".join(f"{t} 3 4 1\n" for part in parts for t in part))

    def refusal(*options):
        assert main(["convert", str(source), str(out), *options]) == 1
        assert not out.exists()
        message = capsys.readouterr().err
        return message, [words.split() for words in re.findall(r"OUT ((?:--\w+ \d+us ?)+)`", message)]

    message, (first, rest) = refusal()
    assert "after event 400, time goes back by 5398000 us, from 5399000 to 1000 us, and stays there" in message
    message, (second, third) = refusal(*rest)
    assert "after event 799, time goes back by 399000 us, from 399000 to 0 us, and stays there" in message
    for options, part in zip((first, second, third), parts, strict=True):
        assert main(["convert", str(source), str(out), *options]) == 0
        assert read_recording(out).events.t.tolist() == [t - part[0] for t in part]
