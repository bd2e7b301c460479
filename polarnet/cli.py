"""The `polarnet` command. Each subcommand is thin: the library does the work."""

import argparse
import contextlib
import functools
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from polarnet import __version__

if TYPE_CHECKING:
    from polarnet.config import Config

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except (ValueError, FileNotFoundError, RuntimeError) as error:
        print(f"polarnet {options.command}: {error}", file=sys.stderr)
        return 1


def project_root(start: Path | None = None) -> Path:
    """The nearest folder at or above `start` (default: here) that holds params.yaml and dvc.yaml."""
    start = (start or Path.cwd()).resolve()
    for folder in [start, *start.parents]:
        if (folder / "params.yaml").exists() and (folder / "dvc.yaml").exists():
            return folder
    raise FileNotFoundError(f"no params.yaml beside a dvc.yaml in {start} or above; run this inside a polarnet clone")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="polarnet", description="DoLP from event cameras: simulate, train, benchmark. `dvc repro` runs it all."
    )
    parser.add_argument("--version", action="version", version=f"polarnet {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_pipeline(commands)
    _add_stores(commands)
    _add_inspect(commands)
    _add_recover(commands)
    _add_onnx(commands)
    _add_benchmark(commands)
    return parser


def _add_pipeline(commands: Commands) -> None:
    doctor = commands.add_parser("doctor", help="what this machine offers: versions, device, bf16, weights, free disk")
    doctor.set_defaults(run=_doctor)

    preset = commands.add_parser("preset", help="write a named experiment or sensor into params.yaml, comments kept")
    preset.add_argument("name", help="a file of conf/experiment or conf/sensor: demo, smoke, paper, noisy, ...")
    preset.set_defaults(run=_preset)

    run = commands.add_parser("run", help="run all stages through Hydra alone, into outputs/run/NAME")
    run.add_argument("overrides", nargs="*", help="as Hydra takes them: experiment=smoke seed=2 paths.data=FOLDER")
    run.set_defaults(run=_run)

    stages = commands.add_parser("stages", help="the names of the stages, in order")
    stages.set_defaults(run=_stages)


def _add_stores(commands: Commands) -> None:
    verify = commands.add_parser("verify", help="check every byte of a store of events, frames or scenes")
    verify.add_argument("store", help="folder, zip or fsspec URL")
    verify.set_defaults(run=_verify)

    export = commands.add_parser("export", help="an event store as files that other tools read")
    export.add_argument("store", help="folder, zip or fsspec URL")
    export.add_argument("folder", type=Path, help="gets a file for each sequence and polarizer")
    export.add_argument("--format", choices=("hdf5", "text"), default="hdf5", help="DSEC's HDF5, or lines of t x y p")
    export.set_defaults(run=_export)

    import_ = commands.add_parser("import", help="the files that export wrote, as an event store")
    import_.add_argument("folder", type=Path)
    import_.add_argument("store", type=Path, help="written anew")
    import_.set_defaults(run=_import)


def _add_inspect(commands: Commands) -> None:
    inspect = commands.add_parser("inspect", help="what is in a camera's file, and a picture of its busiest moment")
    inspect.add_argument("file", type=Path)
    inspect.add_argument("--format", help="where the content does not show it: text, celex5_csv, celex5_bin, dat, ...")
    inspect.add_argument("--height", type=int, help="of the sensor, where the file does not say it")
    inspect.add_argument("--width", type=int)
    inspect.add_argument("--part", metavar="SEQUENCE/ANGLE", help="of an event store")
    inspect.add_argument("--clock-mhz", type=float, help="of a CeleX-5, where it was not 100 MHz")
    inspect.add_argument("--assume-polarity", type=int, choices=(1, -1), help="of events that come without one")
    inspect.add_argument(
        "--hot-pixel-factor", type=float, default=4.0, help="hot: as many times the events of the busiest around (4)"
    )
    inspect.add_argument("--picture", type=Path, help="where to write the PNG (default: FILE.png here)")
    inspect.add_argument("--hot-pixels", type=Path, metavar="PNG", help="where to draw how often each pixel fired")
    inspect.set_defaults(run=_inspect)

    register = commands.add_parser("register", help="lay one camera's recording on another's: the homography")
    register.add_argument("reference", type=Path)
    register.add_argument("file", type=Path)
    register.add_argument("--picture", type=Path, help="where to write a PNG of both event images, before and after")
    register.set_defaults(run=_register)


def _add_recover(commands: Commands) -> None:
    recover = commands.add_parser(
        "recover",
        help="DoLP and AoLP of recordings, or of a camera that runs: frames, pictures, a video and a page",
        description="INPUT is four files, one a polarizer, with --angles; one file of a camera with polarizers on its "
        "pixels, with --mosaic; an event store; a folder of division-of-time captures; or, with --live, lines "
        "`t x y p angle` of a file that grows or of standard input (-).",
    )
    recover.add_argument("input", nargs="+", metavar="INPUT")
    recover.add_argument("--angles", nargs=4, type=int, metavar="DEG", help="polarizers of the four files, in order")
    recover.add_argument(
        "--mosaic", metavar="'A B / C D'", help="polarizers of 2x2 pixels: even row / odd row, degrees"
    )
    recover.add_argument("--sequence", metavar="NAME", help="of an event store with several")
    recover.add_argument("--live", action="store_true", help="recover while events come, and show the latency")
    recover.add_argument(
        "--idle", type=float, default=5.0, metavar="S", help="a live file that stops growing has ended"
    )
    recover.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="reduce files to so many pixels"
    )
    recover.add_argument(
        "--window", default="33.333ms",
        help="a time (33.3ms) or a number of events of all polarizers (20000ev); networks are trained on 1/30 s",
    )  # fmt: skip
    recover.add_argument("--step", help="time between the ends of overlapping windows, from 0.1ms; default: no overlap")
    recover.add_argument(
        "--weights", type=Path, metavar="FILE", help="of the network; default: shipped, or trained here"
    )
    recover.add_argument("--method", help="instead of the network: cf, highpass, cf+gain, e2v, ... of the benchmark")
    recover.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    recover.add_argument("--precision", choices=("fp32", "bf16"), default="fp32", help="of the networks")
    recover.add_argument("--out", type=Path, metavar="FOLDER", help="default: outputs/recover/NAME")
    recover.add_argument("--write", nargs="+", choices=("zarr", "png", "exr", "mp4"), help="default: zarr png mp4")
    recover.add_argument("--video-rate", type=float, default=30.0, metavar="HZ", help="frames a second of the video")
    recover.add_argument("--format", help="of files, where the content does not show it; like the next for inspect")
    recover.add_argument("--height", type=int, help="of the sensor, where the files do not say it")
    recover.add_argument("--width", type=int)
    recover.add_argument("--clock-mhz", type=float)
    recover.add_argument("--assume-polarity", type=int, choices=(1, -1))
    recover.set_defaults(run=_recover)

    replay = commands.add_parser(
        "replay", help="a stored sequence as live lines, at its own pace: polarnet recover --live"
    )
    replay.add_argument("store", help="folder, zip or fsspec URL")
    replay.add_argument("sequence")
    replay.add_argument("--speed", type=float, default=1.0, help="times as fast as recorded")
    replay.set_defaults(run=_replay)


def _add_onnx(commands: Commands) -> None:
    onnx = commands.add_parser(
        "onnx",
        help="a network as an ONNX file, checked with ONNX Runtime",
        description="Writes one window of one stream: events and the state in, DoLP and the new state out. The file "
        "says in its metadata what these are; it gets its name once ONNX Runtime gives what torch gives.",
    )
    onnx.add_argument("file", type=Path, metavar="OUT.onnx")
    onnx.add_argument("--weights", type=Path, metavar="FILE", help="of the network; default: shipped")
    onnx.add_argument("--height", type=int, default=120, help="of the images, which the file is for alone (120)")
    onnx.add_argument("--width", type=int, default=180, help="(180)")
    onnx.set_defaults(run=_onnx)


def _add_benchmark(commands: Commands) -> None:
    docs = commands.add_parser("docs", help="write docs/results/*.json into the tables of README.md and docs/")
    docs.add_argument("--check", action="store_true", help="change nothing; fail where a table is out of date")
    docs.set_defaults(run=_docs)

    benchmark = commands.add_parser(
        "benchmark",
        help="every method on your own photographs or measured scenes; the event budget; the sensitivity",
        description="--scenes makes event sequences of a folder, runs every method that has its weights, prints the "
        "table and writes it with a page; nothing is trained. The other two study the pipeline's own test sequences. "
        "Sizes, motion and sensor are those of params.yaml.",
    )
    asked = benchmark.add_mutually_exclusive_group(required=True)
    asked.add_argument("--scenes", type=Path, metavar="FOLDER", help="photographs or measurements, in all subfolders")
    asked.add_argument("--event-budget", action="store_true", help="quality against events per pixel (paper, Fig. 11)")
    asked.add_argument("--sensitivity", action="store_true", help="quality against mismatch, noise, speed, channels")
    benchmark.add_argument(
        "--weights", type=Path, metavar="FILE", help="of the network; default: trained here, or shipped"
    )
    benchmark.add_argument(
        "--kind", choices=("auto", "photographs", "polarization"), default="auto",
        help="what lies in FOLDER; auto takes .npz files and NAME_0, NAME_45, ... for measured polarization",
    )  # fmt: skip
    benchmark.add_argument("--out", type=Path, metavar="DIR", help="default: below outputs/benchmark")
    benchmark.add_argument("--methods", help="of the two studies, separated by commas")
    benchmark.add_argument("--limit", type=int, metavar="N", help="of the two studies: the first N test sequences")
    benchmark.add_argument("overrides", nargs="*", help="of params.yaml, as Hydra takes them: seed=2")
    benchmark.set_defaults(run=_benchmark)

    measure = commands.add_parser("measure", help="write the figures that README and docs show")
    measure.add_argument(
        "what", nargs="?", choices=("pipeline", "benchmark", "ablation"), default="pipeline",
        help="pipeline: time the README's two commands in a fresh clone of HEAD; benchmark: what data/benchmark holds; "
        "ablation: what a sweep over conf/ablation has left",
    )  # fmt: skip
    measure.add_argument("--sweep", type=Path, metavar="FOLDER", help="of ablation: below outputs/sweeps")
    measure.set_defaults(run=_measure)


def _doctor(options: argparse.Namespace) -> int:
    from polarnet.doctor import findings

    for finding in findings():
        print(finding)
    return 0


def _preset(options: argparse.Namespace) -> int:
    from polarnet.experiments import group_of, write_preset

    root = project_root()
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")
    return 0


def _run(options: argparse.Namespace) -> int:
    from polarnet.experiments import stage_names

    root = project_root()
    chosen = dict(item.split("=", 1) for item in options.overrides if "=" in item)
    name = "-".join([chosen.get("experiment", "demo"), *([chosen["sensor"]] if "sensor" in chosen else [])])
    folder = chosen.get("paths.data", f"outputs/run/{name}")
    overrides = [*options.overrides, *([] if "paths.data" in chosen else [f"paths.data={folder}"])]
    for stage in stage_names(root):
        print(f"== {stage}", flush=True)
        status = subprocess.run([sys.executable, "-m", f"stages.{stage}", *overrides], cwd=root).returncode
        if status:
            print(f"polarnet run: stage {stage} failed; what earlier stages made lies in {folder}", file=sys.stderr)
            return status
    print(f"done: {os.path.join(folder, 'report', 'index.html')}")
    return 0


def _stages(options: argparse.Namespace) -> int:
    from polarnet.experiments import stage_names

    print("\n".join(stage_names(project_root())))
    return 0


def _verify(options: argparse.Namespace) -> int:
    from polarnet.events import frames, store
    from polarnet.events.table import open_group
    from polarnet.simulation import scenes

    checks = {store.FORMAT: store.verify, frames.FORMAT: frames.verify_frames, scenes.FORMAT: scenes.verify_scenes}
    form = open_group(options.store).attrs.get("format")
    if form not in checks:
        raise ValueError(f"{options.store}: expected a store of {', '.join(checks)}, its format is {form!r}")
    problems = checks[form](options.store)
    for problem in problems:
        print(problem)
    if not problems:
        print(f"{options.store}: every sequence is whole")
    return 1 if problems else 0


def _export(options: argparse.Namespace) -> int:
    from polarnet.events.exchange import export_store
    from polarnet.events.store import EventStore

    export_store(EventStore.open(options.store), options.folder, options.format)
    print(f"{options.store} -> {options.folder}")
    return 0


def _import(options: argparse.Namespace) -> int:
    from polarnet.events.exchange import import_store

    import_store(options.folder, options.store)
    print(f"{options.folder} -> {options.store}")
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from polarnet.recordings.inspection import findings, inspect_recording
    from polarnet.recordings.recording import open_recording
    from polarnet.reports.recordings import recording_picture

    chosen = {name: getattr(options, name) for name in ("height", "width", "part", "clock_mhz", "assume_polarity")}
    inspection = inspect_recording(open_recording(options.file, options.format, **chosen), options.hot_pixel_factor)
    for finding in findings(inspection):
        print(finding)
    path = options.picture or Path(f"{options.file.name}.png")
    path.write_bytes(recording_picture(inspection))
    print(f"picture     {path}")
    if options.hot_pixels:
        from polarnet.reports.calibration import draw_hot_pixels

        draw_hot_pixels(inspection.counts, inspection.hot, options.hot_pixels)
        print(f"hot pixels  {options.hot_pixels}")
    return 0


def _register(options: argparse.Namespace) -> int:
    from polarnet.recordings.recording import read_recording
    from polarnet.recordings.registration import event_image, register, warped
    from polarnet.reports.calibration import draw_registration

    reference, moving = (event_image(read_recording(path).events) for path in (options.reference, options.file))
    found = register(reference, moving)
    print(json.dumps({"homography": found.homography.tolist(), "correlation": found.correlation}, indent=2))
    if options.picture:
        draw_registration(reference, moving, warped(moving, found.homography), options.picture)
    return 0


def _recover(options: argparse.Namespace) -> int:
    from polarnet.config import load
    from polarnet.events.streaming import WindowRule, parse_window
    from polarnet.recordings.recording import read_recording
    from polarnet.recover import Arrangement, facts_of, open_files, open_live, open_stream, recover
    from polarnet.reports.recovery import RecoveryWriter
    from polarnet.stokes import parse_mosaic

    config = functools.cache(lambda: load(project_root()))
    length_us, events = parse_window(options.window)
    step_us, step_events = parse_window(options.step) if options.step else (None, None)
    if step_events is not None:
        raise ValueError(f"--step: expected a time such as 0.1ms, got {options.step}")
    rule = WindowRule(length_us, events, step_us)
    stream, words = open_stream(options.method, options.weights, options.device, options.precision, config)
    name = "live" if options.live else Path(options.input[0]).stem
    out = options.out or Path("outputs") / "recover" / name
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    lines = None
    if options.live:
        if len(options.input) != 1 or options.size or options.angles:
            raise ValueError("--live: expected one file or - and, where it has one, a --mosaic; nothing else of files")
        source, lines = open_live(options.input[0], mosaic, options.idle)
    else:
        sides = ("format", "height", "width", "clock_mhz", "assume_polarity")
        read = functools.partial(read_recording, **{side: getattr(options, side) for side in sides})
        arrangement = Arrangement(options.angles, mosaic, options.sequence)
        size = (options.size[0], options.size[1]) if options.size else None
        source = open_files([Path(path) for path in options.input], arrangement, read, size, out / "work", config)
    writer = RecoveryWriter(out, options.write or ("zarr", "png", "mp4"), options.video_rate)
    summary = recover(source, rule, stream, writer)
    facts = facts_of(source, rule, words, summary)
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    left_out = {kind: count for kind, count in lines.counts.items() if count} if lines else {}
    notes = [f"Lines that were left out: {left_out}."] if left_out else []
    print(*notes, f"the page: {writer.write_page(source.name, facts, notes)}", sep="\n")
    return 0


def _replay(options: argparse.Namespace) -> int:
    from polarnet.events.store import EventStore
    from polarnet.recover import replay

    def write(data: bytes) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    replay(EventStore.open(options.store), options.sequence, options.speed, write)
    return 0


def _onnx(options: argparse.Namespace) -> int:
    from polarnet.networks.checkpoint import load_network
    from polarnet.onnx_export import TOLERANCE, export_network
    from polarnet.weights import shipped_weights

    weights = options.weights or shipped_weights()
    found = export_network(*load_network(weights), options.file, options.height, options.width)
    worst = max(found, key=found.__getitem__)
    print(f"{weights} -> {options.file}, {options.file.stat().st_size / 1e6:.1f} MB")
    print(f"ONNX Runtime's outputs are within {found[worst]:.1e} of torch's ({worst}); {TOLERANCE:g} is allowed")
    return 0


def _docs(options: argparse.Namespace) -> int:
    from polarnet.reports.readme import update_results_blocks

    changed = update_results_blocks(project_root(), check=options.check)
    for path in changed:
        print(f"{path}: {'out of date; run polarnet docs' if options.check else 'updated'}")
    return 1 if changed and options.check else 0


def _benchmark(options: argparse.Namespace) -> int:
    from polarnet.config import check_keys, load
    from polarnet.runtime import configure

    root = project_root()
    scenes = options.scenes.resolve() if options.scenes else None
    name = scenes.name if scenes else "event_budget" if options.event_budget else "sensitivity"
    out = (options.out or root / "outputs" / "benchmark" / name).resolve()
    weights = options.weights.resolve() if options.weights else None
    with contextlib.chdir(root):  # paths of conf/config.yaml are relative to it
        check_keys(root, options.overrides)
        config = load(root, options.overrides)
        configure(config.runtime, config.seed)
        if scenes is None:
            return _study(options, config, out, weights)
        return _own_scenes(options, config, scenes, out, weights)


def _own_scenes(options: argparse.Namespace, config: "Config", scenes: Path, out: Path, weights: Path | None) -> int:
    from polarnet.own_scenes import benchmark_folder
    from polarnet.reports.tables import as_plain, score_table

    command = f"polarnet benchmark --scenes {options.scenes}"
    metrics, notes = benchmark_folder(config, scenes, options.kind, out, weights, command)
    reason = json.loads((out / "details.json").read_text())["lpips"]["reason"]
    print(as_plain(score_table(metrics, lpips_reason=reason)))
    for note in notes:
        print(note)
    print(f"the page: {out / 'index.html'}")
    return 0


def _study(options: argparse.Namespace, config: "Config", out: Path, weights: Path | None) -> int:
    from polarnet.studies import STUDIED, run_event_budget, run_sensitivity

    run = run_event_budget if options.event_budget else run_sensitivity
    methods = options.methods.split(",") if options.methods else STUDIED
    run(config, out, methods, options.limit, weights)
    print(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")
    return 0


def _measure(options: argparse.Namespace) -> int:
    from polarnet.measure import measure_ablation, measure_benchmark, measure_pipeline

    root = project_root()
    if options.what == "ablation":
        if options.sweep is None:
            raise ValueError("measure ablation: say --sweep FOLDER, the one that the sweep named at its end")
        path = measure_ablation(root, options.sweep)
    elif options.what == "benchmark":
        path = measure_benchmark(root, root / "data" / "benchmark")
    else:
        path = measure_pipeline(root)
    print(f"wrote {path}; `polarnet docs` brings it into the README")
    return 0


if __name__ == "__main__":
    sys.exit(main())
