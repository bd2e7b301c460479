"""Commands for stores: view, verify, video, replay."""

import argparse
import sys
from pathlib import Path

from polarnet.cli.parsers import Commands, add_reading, add_stored_sequence, reading_of


def add_to(commands: Commands) -> None:
    """Add the commands view, verify, video and replay."""
    for add in (_add_view, _add_verify, _add_video, _add_replay):
        add(commands)


def _add_view(commands: Commands) -> None:
    view = commands.add_parser(
        "view",
        help="look at a store, a recording or a recovery in a page that plays it",
        description="Writes a page that plays events, S0, DoLP and AoLP, and opens it in the browser.",
        epilog="example: polarnet view data/frames.zarr --sequence lake-00",
    )
    view.add_argument("path", type=Path, help="store, folder with stores (of simulate or recover), or a camera's file")
    view.add_argument("--sequence", nargs="+", default=[], metavar="NAME", help="sequences (default: the first twelve)")
    view.add_argument("--out", type=Path, help="page (default: outputs/view/NAME.html)")
    view.add_argument("--no-browser", action="store_true", help="write the page without opening it")
    add_reading(view)
    view.set_defaults(run=_view)


def _add_verify(commands: Commands) -> None:
    verify = commands.add_parser(
        "verify",
        help="check every byte of a store, a checkpoint or a data folder",
        epilog="example: polarnet verify data/events.zarr",
    )
    verify.add_argument(
        "store", help="store (folder or fsspec URL), checkpoint (.safetensors), running.pt or data folder"
    )
    verify.set_defaults(run=_verify)


def _add_video(commands: Commands) -> None:
    video = commands.add_parser(
        "video",
        help="draw a stored sequence and its truth as a video that browsers play",
        description="Draws the events behind each polarizer, red and blue, beside the true S0, DoLP, AoLP and "
        "polarization (hue, saturation and value), one picture a true frame, as H.264 in MP4. `polarnet recover` "
        "draws predictions.",
        epilog="examples:\n  polarnet video outputs/simulate/lake/events.zarr\n"
        "  polarnet video data/events.zarr lake-0 --out lake.mp4",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    video.add_argument("store", help="event store: folder or fsspec URL")
    video.add_argument("sequence", nargs="?", help="name of the sequence (default: the only one)")
    video.add_argument(
        "--truth", metavar="FRAMES", help="frames.zarr or truth.zarr with its true frames (default: beside the store)"
    )
    video.add_argument("--out", type=Path, metavar="FILE", help="MP4 to write (default: outputs/video/SEQUENCE.mp4)")
    video.add_argument(
        "--video-rate", type=float, default=30.0, metavar="HZ", help="pictures a second of the video (default: 30)"
    )
    video.set_defaults(run=_video)


def _add_replay(commands: Commands) -> None:
    replay = commands.add_parser(
        "replay",
        help="print a stored sequence as lines `t x y p angle`, at its own pace",
        description="Prints the events of a stored sequence at the pace of the recording. Pipe them into "
        "`polarnet recover - --live` to try live recovery without a camera.",
        epilog="example: polarnet replay data/events.zarr lake-0 --speed 0.5",
    )
    add_stored_sequence(replay)
    replay.add_argument("--speed", type=float, default=1.0, help="speed relative to the recording (default: 1)")
    replay.set_defaults(run=_replay)


def _view(options: argparse.Namespace) -> int:
    import functools
    import webbrowser

    from polarnet.recordings.recording import read_recording
    from polarnet.reports.player import write_player
    from polarnet.reports.viewing import films_of

    films = films_of(options.path, options.sequence, functools.partial(read_recording, **reading_of(options)))
    path = options.out or Path("outputs", "view", f"{options.path.resolve().name}.html")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_player(path, f"{options.path}", films, {"command": f"polarnet view {options.path}"})
    print(f"page {path}")
    if not options.no_browser:
        webbrowser.open(path.resolve().as_uri())
    return 0


def _video(options: argparse.Namespace) -> int:
    from polarnet.reports.preview import write_true_video
    from polarnet.storage.events import EventStore
    from polarnet.storage.parts import unknown_sequence
    from polarnet.storage.true_frames import open_truth, truth_beside

    store = EventStore.open(options.store)
    name = store.sequences[0] if options.sequence is None and len(store.sequences) == 1 else options.sequence
    if name not in store.sequences:
        raise ValueError(f"{options.store}: {unknown_sequence(name, store.sequences)}")
    truth = options.truth or truth_beside(options.store)
    if truth is None:
        raise ValueError(
            f"{options.store}: expected frames.zarr or truth.zarr beside it, there is none; name the true frames with "
            f"--truth, or draw predictions with `polarnet recover {options.store}`"
        )
    out = options.out or Path("outputs") / "video" / f"{name}.mp4"
    out.parent.mkdir(parents=True, exist_ok=True)
    write_true_video(out, store.read(name), open_truth(truth, name), options.video_rate)
    print(f"video {out}")
    return 0


def _verify(options: argparse.Namespace) -> int:
    from polarnet.cli.verification import verified

    results = list(verified(options.store))
    if not results:
        raise ValueError(f"{options.store}: expected a store, a checkpoint or a folder that holds some, found none")
    problems = [problem for _, found in results for problem in found]
    for problem in problems:
        print(problem)
    for name, found in results:
        if not found:
            print(f"{name}: intact")
    return 1 if problems else 0

    return 0


def _replay(options: argparse.Namespace) -> int:
    from polarnet.recordings.live import replay
    from polarnet.storage.events import EventStore

    def write(data: bytes) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    replay(EventStore.open(options.store).read(options.sequence), options.speed, write)
    return 0
