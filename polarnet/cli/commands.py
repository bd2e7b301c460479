"""The command line of `polarnet`: every command with its arguments. It imports no library, so help is quick."""

import argparse
import functools
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, TypeAlias

from polarnet import __version__
from polarnet.terminal.suggestions import did_you_mean

INVALID_CHOICE = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")


class Command(argparse.ArgumentParser):
    """A parser whose errors are one line that suggests a word for a mistyped one."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit with status 2."""
        if choice := INVALID_CHOICE.search(message):
            message += did_you_mean(choice[1], re.findall(r"[\w-]+", choice[2]))
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")

    def refuse(self, words: Sequence[str]) -> NoReturn:
        """Print that these words are no arguments, and exit with status 2."""
        option = words[0].partition("=")[0]
        self.error(f"unrecognized arguments: {' '.join(words)}{did_you_mean(option, self._option_string_actions)}")

    def check_inputs(self, options: argparse.Namespace) -> None:
        """FileNotFoundError for an input that does not exist; a command imports its libraries for seconds after it.

        URLs, standard input (-) and words KEY=VALUE are no paths.
        """
        values = [getattr(options, action.dest) for action in self._actions if action.type in (input_name, input_path)]
        for name in (str(one) for value in values if value for one in (value if isinstance(value, list) else [value])):
            if not (name == "-" or "://" in name or "=" in name or Path(name).exists()):
                raise FileNotFoundError(f"{name}: there is no such file or folder")


AddCommand: TypeAlias = Callable[..., Command]  # `_command` without its first argument
AddArgument: TypeAlias = Callable[..., object]  # `add_argument` of a command

_wrapped = functools.partial(textwrap.fill, width=100, subsequent_indent="  ")


def command_parser() -> argparse.ArgumentParser:
    """Parser of all commands.

    `run` of its result names the module below polarnet.cli and the function of the command, `parser` is the command's.
    """
    parser = Command(
        prog="polarnet",
        description="Degree of linear polarization (DoLP) from event cameras: simulation, training, benchmark and "
        "recovery. `dvc repro` runs the pipeline.",
    )
    parser.add_argument("--version", action="version", version=f"polarnet {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_project, _stores, _simulate, _inspect, _recover, _recover_rotating, _convert, _fit_sensor, _onnx,
                _benchmark):  # fmt: skip
        add(functools.partial(_command, commands))
    return parser


def positive(text: str) -> float:
    """An argument above 0; its name stands in argparse's message about another text."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


def input_name(text: str) -> str:
    """An argument that names a file or folder, which `Command.check_inputs` looks for."""
    return text


def input_path(text: str) -> Path:
    """The same as a path on this machine."""
    return Path(text)


def _command(
    commands: "argparse._SubParsersAction[Command]",
    name: str,
    run: str,
    summary: str,
    *examples: str,
    description: str = "",
) -> Command:
    command = commands.add_parser(
        name,
        help=summary,
        description="\n".join(map(_wrapped, description.split("\n"))),
        epilog="\n  ".join(["examples:", *(f"polarnet {example}" for example in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=run, parser=command)
    return command


def _project(command: AddCommand) -> None:
    add = command(
        "demo",
        "simulate.demo",
        "a first result in a few minutes: simulate a built-in photograph, recover its DoLP and score it",
        "demo sensor=noisy",
        description="Simulates a camera with four polarizers that moves over a photograph, recovers DoLP and AoLP from "
        "its events with the shipped weights, and scores them against the truth. `polarnet simulate` and `polarnet "
        "recover --truth` do the halves, on your own files.",
    ).add_argument
    add("--out", type=Path, metavar="FOLDER", default=Path("outputs/demo"), help="default: outputs/demo")
    _overrides(add)
    command("doctor", "doctor.doctor", "report versions, device, weights, extras, memory and disk", "doctor")
    add = command(
        "preset", "project.preset", "write a named experiment or sensor into params.yaml", "preset smoke"
    ).add_argument
    add("name", help="name of a file in conf/experiment or conf/sensor: demo, smoke, paper, noisy, ...")
    add = command(
        "new",
        "project.new",
        "write a project with the pipeline: dvc.yaml, params.yaml, conf, stages",
        "new lake && cd lake && polarnet preset smoke && dvc repro",
        description="Writes a folder in which `dvc repro` runs the pipeline with the installed polarnet. The stages "
        "run again after a change of version.txt, which names polarnet's version.",
    ).add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder to write; it must be new or empty")


def _stores(command: AddCommand) -> None:
    add = command(
        "view",
        "stores.view",
        "look at a store, a recording or a recovery in a page that plays it",
        "view data/frames.zarr --sequence lake-00",
        description="Writes a page that plays events, S0, DoLP and AoLP, and opens it in the browser. If the folder "
        "has a page, as that of a recovery does, it opens that page.",
    ).add_argument
    add("path", type=input_path, help="store, folder with stores, recovery, or a camera's file")
    add("--sequence", nargs="+", metavar="NAME", help="sequences (default: the first twelve)")
    add("--out", type=Path, help="page (default: outputs/view/NAME.html)")
    add("--no-browser", action="store_true", help="write the page without opening it")
    _reading(add)
    add = command(
        "verify",
        "stores.verify",
        "check every byte of a store, a checkpoint or a data folder",
        "verify data/events.zarr",
    ).add_argument
    add("store", type=input_name, help="store or its URL, checkpoint (.safetensors), running.pt, folder")
    add = command(
        "video",
        "stores.video",
        "draw a stored sequence and its truth as a video that browsers play",
        "video outputs/simulate/lake/events.zarr",
        "video data/events.zarr lake-0 --out lake.mp4",
        description="Draws the events behind each polarizer, red and blue, beside the true S0, DoLP, AoLP and "
        "polarization (hue, saturation and value), one picture a true frame, as H.264 in MP4. `polarnet recover` draws "
        "predictions.",
    ).add_argument
    add("store", type=input_name, help="event store: folder or fsspec URL")
    add("sequence", nargs="?", help="name of the sequence (default: the only one)")
    add("--truth", type=input_name, metavar="FRAMES", help="true frames (default: those beside the store)")
    add("--out", type=Path, metavar="FILE", help="MP4 to write (default: outputs/video/SEQUENCE.mp4)")
    add = command(
        "replay",
        "stores.replay",
        "print a stored sequence as lines `t x y p angle`, at its own pace",
        "replay data/events.zarr lake-0 --speed 0.5",
        description="Prints the events of a stored sequence at the pace of the recording. Pipe them into `polarnet "
        "recover - --live` to try live recovery without a camera.",
    ).add_argument
    add("store", type=input_name, help="event store: folder or fsspec URL")
    add("sequence", help="name of the sequence")
    add("--speed", type=positive, default=1.0, help="speed relative to the recording (default: 1)")


def _simulate(command: AddCommand) -> None:
    simulate = command(
        "simulate",
        "simulate.simulate",
        "make polarization events from a photograph, a video or measured polarization",
        "simulate lake.jpg sensor=noisy synthesize.duration_s=2",
        "simulate walk.mp4 --size 240 320 --upsample --to store evt3",
        "simulate frames/ --fps 100 polarizers=micropolarizers readout.max_events_per_s=5e6",
        'simulate dofp.mp4 --mosaic "90 45 / 135 0" --out outputs/dofp',
        description="""\
Makes the events of a camera with four polarizers, the true DoLP and AoLP, and a preview video. INPUT is one of:
- a photograph, or one measurement of polarization: a sensor moves over it (sections ingest and synthesize)
- a video, or a folder of frames: hue becomes AoLP, saturation DoLP and value S0; the pixels see those of the frames
- a folder of frames behind polarizers, NAME_0, NAME_45, NAME_90, NAME_135 for each
- with --mosaic: a video or a folder of raw frames of a polarization camera
Words KEY=VALUE replace values of params.yaml or choose presets of conf/: sensor=noisy polarizers=film seed=2.""",
    )
    simulate.set_defaults(overrides=[])
    add = simulate.add_argument
    add("words", nargs="+", type=input_name, metavar="INPUT", help="input, and after it words KEY=VALUE")
    add("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/simulate/NAME)")
    add("--to", nargs="+", default=["store"], help="store, hdf5 (as DSEC), text or evt3 (default: store)")
    add("--fps", type=positive, metavar="HZ", help="frames a second (default: as a video states)")
    add("--times", type=input_path, metavar="FILE", help="frame times, one a line (default: INPUT/timestamps.txt)")
    add("--time-unit", choices=("us", "ms", "s"), default="us", help="unit of these times (default: us)")
    add("--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="cut and reduce the frames to this size")
    add("--upsample", action="store_true", help="interpolate frames so that nothing moves by more than 1 px a step")
    add("--grey", action="store_true", help="take colour frames as grey, which are unpolarized")
    add("--mosaic", metavar="'A B / C D'", help="polarizer angles of 2x2 pixels of raw frames: even row / odd row")
    add("--white", type=float, metavar="LEVEL", help="saturation (default: the most of the first frame's bits)")
    add("--no-preview", action="store_true", help="write no preview video")


def _inspect(command: AddCommand) -> None:
    add = command(
        "inspect",
        "stores.inspect",
        "summarise a camera's file and draw its busiest moment, or list the sequences of a store",
        "inspect recording.aedat4",
        description="Prints format, sensor size (height x width), duration, event counts, rates and hot pixels of a "
        "camera's file, with its longest gap and empty rows. Draws its busiest moment as a PNG, and "
        "lists the hot pixels for `polarnet recover --hot-pixels FILE`. Of a store it names the sequences.",
    ).add_argument
    add("file", type=input_name, help="file of a camera, or a store to list")
    _reading(add)
    add("--out", type=Path, metavar="FOLDER", help="folder of these files (default: outputs/inspect)")


def _recover(command: AddCommand) -> None:
    add = command(
        "recover",
        "recover.run",
        "recover DoLP and AoLP from recordings or from a running camera",
        'recover recording.aedat4 --mosaic "90 45 / 135 0"',
        'recover recording.aedat4 --mosaic "90 45 / 135 0" --frames',
        "recover 0.raw 45.raw 90.raw 135.raw --angles 0 45 90 135 --hot-pixels found",
        "recover outputs/simulate/lake/events.zarr --truth",
        "recover data/events.zarr --sequence lake-0 --step 1ms --write mp4",
        'recover dv://camera --live --mosaic "90 45 / 135 0"',
        description="""\
Writes the frames as numbers, a video and a page. INPUT is one of:
- four files, one for each polarizer, with --angles
- one file of a camera with polarizers on its pixels, with --mosaic
- an event store
- with --live, standard input (-) or a file with lines `t x y p angle`, or a camera with --mosaic: \
dv://HOST:PORT of a program that streams its events, or dv://camera""",
    ).add_argument
    add("input", nargs="+", type=input_name, metavar="INPUT", help="recordings, an event store, or -")
    add("--angles", nargs=4, type=int, metavar="DEG", help="polarizer angles of the four files, in order")
    add("--mosaic", metavar="'A B / C D'", help="polarizer angles of 2x2 pixels in degrees: even row / odd row")
    add("--sequence", metavar="NAME", help="sequence of an event store with several")
    add(
        "--truth", nargs="?", type=input_name, const="", metavar="FRAMES",
        help="score the frames of an event store: frames.zarr or truth.zarr (default: those beside the store)",
    )  # fmt: skip
    add("--frames", action="store_true", help="use the frames of a camera with --mosaic too")
    add("--live", action="store_true", help="recover while events arrive, and print the latency")
    add("--idle", type=float, default=5.0, metavar="S", help="seconds until a silent camera has ended (default: 5)")
    _cleaning(add)
    add("--window", help="length in time (default: 33.333ms, as in training)")
    add("--step", help="time between frames (default: a window)")
    add(
        "--method",
        help="registered (the network over a whole recording, the default), ours (the network from window to window, "
        "the default of --live), or another method of the benchmark: cf, highpass, cf+gain, e2v, ...",
    )
    add("--weights", type=input_path, metavar="FILE", help="checkpoint of the method (default: the shipped one)")
    add(
        "--thresholds", nargs=2, type=float, metavar=("ON", "OFF"),
        help="contrast thresholds of the camera, natural-log intensity (default: estimated from the events)",
    )  # fmt: skip
    add("--binning", type=int, metavar="N", help="show the network blocks of N x N pixels (default: as in training)")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto)")
    add("--precision", choices=("auto", "fp32", "bf16"), default="auto", help="of the network (default: auto)")
    add("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/recover/NAME)")
    formats = ("zarr", "mp4")
    add("--write", nargs="+", choices=formats, default=formats, help="files (default: zarr mp4)")
    _reading(add)


def _recover_rotating(command: AddCommand) -> None:
    add = command(
        "recover-rotating",
        "recover.rotating",
        "recover DoLP and AoLP from one camera behind a rotating polarizer",
        "recover-rotating camera.raw --rate 15 --start-angle 30",
        "recover-rotating camera.raw --triggers turns.txt",
        description="Fits every half turn of the polarizer, pixel by pixel. Writes the files of `polarnet recover`.",
    ).add_argument
    add("input", type=input_path, metavar="INPUT", help="recording of the camera")
    add("--rate", type=float, metavar="HZ", help="turns a second of the polarizer; negative: the other way")
    add("--triggers", type=input_path, metavar="FILE", help="times of its triggers in us, one a turn: text or HDF5")
    add("--start-angle", type=float, default=0.0, metavar="DEG", help="at time 0 or the first trigger (default: 0)")
    add("--step", help="time between frames: 10ms (default: half a turn)")
    add("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/recover/NAME)")
    _reading(add)


def _convert(command: AddCommand) -> None:
    add = command(
        "convert",
        "convert.convert",
        "convert a recording or an event store to HDF5 (DSEC's layout), text or EVT3",
        "convert recording.aedat4 first.h5 --start 500ms --stop 2s",
        "convert data/events.zarr exported --to evt3 --sequence lake-0",
        description="Reads any recording that `polarnet inspect` reads, repairs it as reading does, and writes its "
        "events, or those of a time span. Times in OUT count from the start of the span. Of an event store, "
        "writes a folder with one file for each sequence and channel.",
    ).add_argument
    add("file", type=input_name, metavar="IN", help="file of a camera, a bag, or an event store (folder or fsspec URL)")
    add("out", type=Path, metavar="OUT", help="file to write; of an event store, the folder")
    add("--to", choices=("evt3", "hdf5", "text"), help="format (default: by the suffix of OUT; of a store: hdf5)")
    add("--start", metavar="TIME", help="start of the span after the first event: 500ms (default: 0s)")
    add("--stop", metavar="TIME", help="end of the span after the first event, exclusive")
    add("--sequence", nargs="+", metavar="NAME", help="sequences of an event store (default: all)")
    _reading(add)


def _fit_sensor(command: AddCommand) -> None:
    add = command(
        "fit-sensor",
        "fit_sensor.run",
        "fit the simulated sensor to a camera's recordings",
        "fit-sensor --name lab --static wall.raw --flicker f2.raw f60.raw --frequency 2 60 --contrast 0.8",
        description="Estimates thresholds, their deviations, bandwidth, refractory period, leak, shot noise and hot "
        "pixels of a camera from its recordings; prints a table and writes conf/sensor/NAME.yaml. docs/fit-sensor.md "
        "says what to record.",
    ).add_argument
    add("--name", required=True, help="name of the sensor: sensor=NAME uses it")
    add("--static", type=input_path, metavar="FILE", help="recording under constant light")
    add("--static-light", type=float, metavar="DN", help="its brightness, 0 (covered lens) to 255 (default: 127.5)")
    add("--flicker", type=input_path, nargs="+", metavar="FILE", help="recordings of light that varies as a sine")
    add("--contrast", type=float, metavar="C", help="contrast of the flicker, (max - min) / (max + min)")
    add("--frequency", type=float, nargs="+", metavar="HZ", help="frequency of each flicker recording")
    add("--flicker-light", type=float, default=127.5, metavar="DN", help="mean of the flicker (default: 127.5)")
    _reading(add)


def _onnx(command: AddCommand) -> None:
    add = command(
        "onnx",
        "convert.onnx",
        "export a network as an ONNX file, checked with ONNX Runtime",
        "onnx polarnet.onnx --height 260 --width 346",
        description="The exported network takes the events of one window and a state, and returns DoLP and the new "
        "state; the file's metadata describes all inputs and outputs. The file is renamed to OUT.onnx once ONNX "
        "Runtime reproduces torch's outputs.",
    ).add_argument
    add("file", type=Path, metavar="OUT.onnx", help="file to write")
    add("--weights", type=input_path, metavar="FILE", help="checkpoint of the network (default: the shipped one)")
    add("--height", type=int, default=120, help="sensor rows; the file works for this size only (default: 120)")
    add("--width", type=int, default=180, help="sensor columns (default: 180)")


def _benchmark(command: AddCommand) -> None:
    benchmark = command(
        "benchmark",
        "benchmark.run",
        "score every method on your own scenes or recordings",
        "benchmark --scenes photographs/ --limit 10 --methods cf,highpass,ours",
        "benchmark --recordings pdavis/ --hot-pixels found",
        description="--scenes simulates event sequences from the pictures of a folder, runs every method whose weights "
        "are available, prints the table and writes it with a page; it trains nothing. --recordings does the same on "
        "recordings of a camera with a polarizer mosaic that hold frames. params.yaml sets sizes, motion and sensor.",
    )
    asked = benchmark.add_mutually_exclusive_group(required=True).add_argument
    asked("--scenes", type=input_path, metavar="FOLDER", help="photographs or measured polarization, in any depth")
    asked("--recordings", type=input_path, metavar="FOLDER", help="HDF5 of E2P, AEDAT of a DAVIS with frames")
    add = benchmark.add_argument
    add("--weights", type=input_path, metavar="FILE", help="checkpoint of ours (default: the shipped one)")
    add(
        "--kind", choices=("auto", "photographs", "polarization"), default="auto",
        help="of --scenes; auto recognises .npz and NAME_0, NAME_45, ... as measured polarization (default: auto)",
    )  # fmt: skip
    add("--mosaic", metavar="'A B / C D'", help="polarizers of 2x2 pixels of --recordings (default: 90 45 / 135 0)")
    _cleaning(add)
    add("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/benchmark/NAME)")
    add("--methods", help="separated by commas (default: benchmark.methods)")
    add("--limit", type=int, metavar="N", help="use only N pictures of --scenes")
    _overrides(add)


def _overrides(add: AddArgument) -> None:
    add("overrides", nargs="*", help="values that replace those of params.yaml: sensor=noisy seed=2")


def _cleaning(add: AddArgument) -> None:
    """Options that remove noise from events, which `polarnet.cli.options.cleaning_of` reads."""
    add("--hot-pixels", metavar="found|FILE", help="pixels to remove: those found, or lines `x y`")
    add("--background", metavar="TIME", help="remove events without a neighbour's in TIME: 10ms")


def _reading(add: AddArgument) -> None:
    """Options that describe a camera's file, which `polarnet.cli.options.reading_of` reads."""
    add("--format", help="of the input, if it cannot be recognised: text, celex5_csv, celex5_bin, ...")
    add("--part", help="of a file with several: topic of a bag, stream of AEDAT, camera of M3ED or MVSEC")
    add("--height", type=int, help="rows of the sensor, if the file does not state them")
    add("--width", type=int, help="columns of the sensor, if the file does not state them")
