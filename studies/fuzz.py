"""Random damage to everything that a user may hand in: python -m studies.fuzz [--minutes N | --cases N] [--write]

Kinds: pictures, recordings, parameters (values of the configuration, and text of params.yaml), stores and checkpoints.
Half of the damaged stores and checkpoints get valid checksums, as a hostile file would have. A case must end with a
result or with a refusal of the exceptions that commands print as one line. The bad endings are:

- traceback: another exception, or a refusal of several lines (parameters: a line for each key)
- crash: the process ended
- hang: a case took longer than `HANG_S`
- memory: a case took more than `MAX_MIB`; a picture of the largest permitted size needs about as much

Two processes share the cases; the case's number decides its damage. --write puts the counts into
docs/results/reliability.json. Bad cases are listed in the log.
"""

import json
import math
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from safetensors.torch import save

from polarnet.config.tree import ROOT_VARIABLE, Config
from polarnet.events.stream import Events
from polarnet.networks.checkpoint import load_checkpoint, save_checkpoint
from polarnet.pictures.images import read_rgb
from polarnet.recordings.formats import isolated
from polarnet.recordings.recording import FORMATS
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore
from polarnet.storage.parts import _checksum
from studies.faults import REFUSALS, read_store
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
PROCESSES = 2
SLICE_S = 2.0  # of one kind, before the next kind's turn
HANG_S = 20
MAX_MIB = 4096
SLOW = ("store", "e2p", "esfp", "metavision", "dsec", "rosbag", "aedat4", "event_stream")
"""Formats read in milliseconds, most of them in a process of their own; studies.fuzz_recordings has more cases."""
ENDINGS = ("read", "refused", "traceback", "crash", "hang", "memory")
BAD = ENDINGS[2:]
BYTES = (0, 10, 32, 44, 45, 46, 48, 57, 101, 127, 255)
VALUES: tuple[Any, ...] = (
    0, 1, -1, 2, 3.5, -0.0, 1e-300, 1e300, 2**31, 2**63, 10**30, float("nan"), float("inf"), True, None, "", "nan",
    "../x", "a\nb", "\0", "<b>", "${seed}", [], [[]], [1, 2], [0, -1, 3], {}, {"a": 1}, "x" * 5000, "\ud800", "1e5",
)  # fmt: skip
WORDS = ("!!python/object/apply:os.system [x]", "&a [*a]", "*b", "<<: {}", "? ", "- ", "\t", "{", "]", "'", '"', "%",
         "@", "~", ".inf", "0x", "1_0", "2001-01-01", "|", ">", "#", ": ", "\n", "\0", "\u2028")  # fmt: skip

Generator = np.random.Generator
Case = Callable[[Generator], None]
"""Draws a damaged input and reads it."""


class Hang(BaseException):
    """A case that takes too long; no `except Exception` catches it."""


def changed(content: bytes, generator: Generator) -> bytes:
    """Bytes with one to four changes: a bit, a byte, a number of four bytes, a cut, a deletion, a repetition."""
    for _ in range(int(generator.integers(1, 5))):
        reach = min(len(content), 200) if generator.random() < 0.5 else len(content)  # headers are at the start
        place, kind = int(generator.integers(max(1, reach))), int(generator.integers(7))
        length = int(generator.integers(1, 40))
        head, tail = content[:place], content[place:]
        if kind == 0 and tail:
            tail = bytes([tail[0] ^ 1 << length % 8]) + tail[1:]
        elif kind == 1:
            tail = bytes([BYTES[length % len(BYTES)]]) + tail[1:]
        elif kind == 2:
            tail = int(generator.integers(2**32)).to_bytes(4, "little") + tail[4:]
        elif kind == 3 and length < 10:
            tail = b""
        elif kind == 4:
            tail = tail[length:]
        elif kind == 5:
            tail = tail[:length] * 2 + tail[length:]
        else:
            tail = generator.bytes(length % 12) + tail
        content = head + tail
    return content


def pictures(folder: Path) -> Case:
    """Small pictures of six formats."""
    rgb = generator_for(0, "fuzz", "picture").integers(0, 256, (12, 16, 3)).astype(np.uint8)
    files = [folder / f"picture.{extension}" for extension in ("png", "jpg", "tif", "bmp", "webp", "hdr")]
    for file in files:
        cv2.imwrite(str(file), rgb.astype(np.float32) / 255 if file.suffix == ".hdr" else rgb)
    sound = [file.read_bytes() for file in files]

    def case(generator: Generator) -> None:
        number = int(generator.integers(len(files)))
        files[number].write_bytes(changed(sound[number], generator))
        read_rgb(files[number])

    return case


def recordings(folder: Path) -> Case:
    """Small recordings of every format whose library is installed."""
    sys.path[:0] = [str(ROOT / "tests" / "recordings"), str(ROOT / "tests")]
    from damaged_files import EVENTS, Sample
    from recording_fixtures import random_events

    events = random_events(0, EVENTS, 300_000, 260, 346)
    quick, slow = (
        [Sample(form, folder, events) for form in FORMATS if (form in SLOW) == is_slow] for is_slow in (0, 1)
    )

    def case(generator: Generator) -> None:
        samples = slow if generator.random() < 0.01 else quick
        sample = samples[int(generator.integers(len(samples)))]
        number = int(generator.integers(len(sample.sound)))
        content = changed(sample.sound[number], generator)
        chunk, says_format = int(generator.integers(1, 101)), generator.random() < 0.8
        if sample.ending_of(content, number, says_format, chunk) == "refused":
            raise ValueError("refused")

    return case


def parameters(folder: Path) -> Case:
    """Values of the whole configuration, and now and then the text of a section."""
    os.environ[ROOT_VARIABLE] = str(ROOT)
    with initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "conf")):
        sound = OmegaConf.to_container(compose("config"), resolve=True)
    assert isinstance(sound, dict)
    sections = [key for key, value in sound.items() if isinstance(value, dict)]
    texts = {key: OmegaConf.to_yaml({key: sound[key]}).encode() for key in sections}

    def case(generator: Generator) -> None:
        if generator.random() < 0.05:
            key = sections[int(generator.integers(len(sections)))]
            text, word = changed(texts[key], generator), WORDS[int(generator.integers(len(WORDS)))]
            place = int(generator.integers(len(text) + 1))
            (folder / "params.yaml").write_bytes(text[:place] + word.encode() + text[place:])
            given = read_yaml(folder / "params.yaml")
            Config(**{**sound, **given})
        else:
            Config(**with_other_values(sound, generator))

    return case


def read_yaml(file: Path) -> dict[Any, Any]:
    """The content of a YAML file as the commands read it: Hydra's refusals become those of a command."""
    import yaml
    from omegaconf.errors import OmegaConfBaseException

    try:
        content = OmegaConf.to_container(OmegaConf.load(file), resolve=True)
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        raise ValueError(f"{file.name}: {type(error).__name__}") from None
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {"content": content}


def with_other_values(tree: Mapping[Any, Any], generator: Generator) -> dict[str, Any]:
    """A copy of a configuration in which one to three values at any depth are others, missing or renamed."""
    tree = dict(tree)
    for _ in range(int(generator.integers(1, 4))):
        inner = tree
        while True:
            key = list(inner)[int(generator.integers(len(inner)))]
            if not isinstance(inner[key], dict) or not inner[key] or generator.random() < 0.05:
                break
            inner[key] = dict(inner[key])
            inner = inner[key]
        value, kind = inner.pop(key), generator.random()
        if kind < 0.05:
            inner[f"{key}x"] = value
        elif kind < 0.3 and isinstance(value, int | float):
            inner[key] = value * 10.0 ** int(generator.integers(-12, 13)) * (1 if generator.random() < 0.7 else -1)
        elif kind > 0.35 or len(inner) == 0:
            inner[key] = VALUES[int(generator.integers(len(VALUES)))]
    return tree


def stores(folder: Path) -> Case:
    """A store of events; its header, half of the time under a valid checksum, or a file of a part is damaged."""
    path, generator = folder / "events.zarr", generator_for(0, "fuzz", "store")
    store = EventStore.create(path, ["a", "b"], 8, 12, {"seed": 1})
    for name in ("a", "b"):
        t = torch.from_numpy(np.sort(generator.integers(0, 5000, 50)))
        x, y = (torch.from_numpy(generator.integers(0, side, 50)).short() for side in (12, 8))
        store.write(name, [Events(t, x, y, torch.ones(50, dtype=torch.int8), 8, 12)] * 4, 5000)
    store.finish()
    sound = {file: file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    header = path / "zarr.json"

    def case(generator: Generator) -> None:
        for file, content in sound.items():
            file.write_bytes(content)
        file = [*sound][int(generator.integers(len(sound)))]
        if file == header and generator.random() < 0.5:
            content = json.loads(sound[header])
            about = with_other_values({k: v for k, v in content["attributes"].items() if k != "checksum"}, generator)
            about = {**about, "checksum": _checksum(about)}
            header.write_text(json.dumps({**content, "attributes": about}))
        else:
            file.write_bytes(changed(sound[file], generator))
        read_store(path)

    return case


def checkpoints(folder: Path) -> Case:
    """A checkpoint; half of the damaged tensor files have the hash that the record names."""
    path = folder / "best.safetensors"
    tensors = {"w": torch.arange(12.0).view(3, 4), "b": torch.zeros(3)}
    save_checkpoint(path, tensors, {"network": "x", "config": {"a": 1}, "in_channels": 4})
    record, weights = path.with_suffix(".json").read_text(), save(tensors)
    metadata = json.loads(record)

    def case(generator: Generator) -> None:
        content, text = weights, record.encode()
        if generator.random() < 0.6:
            content = changed(weights, generator)
            if generator.random() < 0.7:
                text = json.dumps(metadata | {"sha256": sha256(content)}).encode()
        elif generator.random() < 0.5:
            text = json.dumps(with_other_values(metadata, generator)).encode("utf-8", "replace")
        else:
            text = changed(text, generator)
        path.write_bytes(content)
        path.with_suffix(".json").write_bytes(text)
        load_checkpoint(path)

    return case


KINDS = {each.__name__: each for each in (pictures, recordings, parameters, stores, checkpoints)}


def ending(kind: str, case: Case, number: int) -> tuple[str, str]:
    """One of ENDINGS but `crash` for a case, and the message of a bad one."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        case(generator_for(1, f"{kind} {number}", "fuzz"))
        result = "read", ""
    except REFUSALS as error:
        lines = kind != "parameters" and "\n" in str(error)
        result = ("traceback", f"several lines: {error}") if lines else ("refused", "")
    except Hang:
        result = "hang", f"longer than {HANG_S} s"
    except Exception as error:
        result = "traceback", repr(error)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
    return ("memory", f"{grown} MiB") if grown > MAX_MIB else result


def worker(counts: Any, state: Any, until: float, cases: int) -> None:
    """Run slices of all kinds in turn until a time, or until each kind's number reaches `cases`.

    `counts` (kinds x endings) and `state` (kind, start of the case, then the next number of each kind) are shared, so
    that they outlive a crash.
    """

    def interrupt(*_: Any) -> None:
        raise Hang

    signal.signal(signal.SIGALRM, interrupt)
    torch.set_num_threads(1)
    isolated.PATIENCE_S = 5
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as scratch:
        calls = []
        for kind, make in KINDS.items():
            (folder := Path(scratch, kind)).mkdir()
            calls.append(make(folder))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and others write lines about damage
        resource.setrlimit(resource.RLIMIT_AS, (2 * MAX_MIB << 20, 2 * MAX_MIB << 20))
        while time.time() < until and min(state[2:]) < cases:
            for place, (kind, case) in enumerate(zip(KINDS, calls, strict=True)):
                stop = min(until, time.time() + SLICE_S)
                while (start := time.time()) < stop and (number := int(state[2 + place])) < cases:
                    state[0], state[1], state[2 + place] = place, start, number + PROCESSES
                    what, message = ending(kind, case, number)
                    counts[place * len(ENDINGS) + ENDINGS.index(what)] += 1
                    if what in BAD:
                        print(f"{what}: {kind} {number}: {message[:1000]}", flush=True)
        state[1] = math.inf  # the end of the process is no case


def fuzz(minutes: float, cases: int) -> dict[str, dict[str, int]]:
    """Endings of the cases of each kind; a new process replaces one that crashes or hangs, from the next case on."""
    until = time.time() + 60 * minutes
    context = multiprocessing.get_context("spawn")
    counts = [context.RawArray("q", len(KINDS) * len(ENDINGS)) for _ in range(PROCESSES)]
    states = [context.RawArray("d", [0, 0, *[first] * len(KINDS)]) for first in range(PROCESSES)]
    running: dict[int, Any] = {}
    finished: set[int] = set()
    while len(finished) < PROCESSES:
        for place in set(range(PROCESSES)) - finished:
            process, state = running.get(place), states[place]
            if process is None:
                state[1] = math.inf  # its set-up counts as no case
                running[place] = context.Process(target=worker, args=(counts[place], state, until, cases), daemon=True)
                running[place].start()
            elif process.exitcode == 0:
                finished.add(place)
            elif process.exitcode is not None or time.time() - state[1] > 2 * HANG_S:
                kind = int(state[0])
                what = "hang" if process.exitcode is None else "crash"
                print(f"{what}: {[*KINDS][kind]} {state[2 + kind] - PROCESSES:.0f}: {process.exitcode}", flush=True)
                if math.isinf(state[1]):
                    raise RuntimeError("a process ended before its first case")
                process.kill()
                process.join()
                counts[place][kind * len(ENDINGS) + ENDINGS.index(what)] += 1
                del running[place]
        time.sleep(1)
    sums = np.sum([np.array(each).reshape(len(KINDS), -1) for each in counts], axis=0).tolist()
    return {kind: dict(zip(ENDINGS, row, strict=True)) for kind, row in zip(KINDS, sums, strict=True)}


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--cases", type=int, default=10**6, help="largest number of cases of each kind")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    kinds = fuzz(arguments.minutes, arguments.cases)
    headlines = {
        "fuzz_cases": sum(sum(endings.values()) for endings in kinds.values()),
        "fuzz_crashes": sum(endings[what] for endings in kinds.values() for what in BAD),
    }
    print(json.dumps({**headlines, "kinds": kinds}, indent=2))
    if arguments.write:
        print(write_section(ROOT, "reliability", "fuzz", kinds, record, headlines))


if __name__ == "__main__":
    main()
