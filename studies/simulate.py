"""`polarnet simulate` on a sample of each kind of input: python -m studies.simulate [--write] [--picture]

The samples are made from a built-in photograph: the photograph itself, and clips of a 180 x 120 px camera that moves
over it for a second, at 30 frames a second and 4 px a frame. Each runs twice, and the second run counts, whose kernels
are compiled. Its seconds include reading the input and writing the event store, without the preview. `--write` puts
events, seconds and events/s into docs/results/camera.json, section `simulate_inputs`; `--picture` draws
docs/pictures/simulate.png.
"""

import contextlib
import io
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from polarnet.cli import main as polarnet
from polarnet.events.mosaic import places_of
from polarnet.simulation import BUILTIN_PHOTOS, read_rgb, scene_from_rgb
from polarnet.stokes import POLARIZER_ANGLES_DEG, intensities_from_stokes, parse_mosaic
from polarnet.storage.events import EventStore
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
PHOTO = "astronaut"
HEIGHT, WIDTH, FRAMES, RATE_HZ, STEP_PX = 120, 180, 31, 30, 4
MOSAIC = "90 45 / 135 0"
OFFSET = 40  # first row and column of the camera on the photograph


def clip_of(picture: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "n h2 w2 c"]:
    """8-bit frames of a camera that moves to the right and down over a picture in [0, 1]."""
    starts = [(OFFSET + STEP_PX * k // 4, OFFSET + STEP_PX * k) for k in range(FRAMES)]
    cuts = [picture[top : top + HEIGHT, left : left + WIDTH] for top, left in starts]
    return np.rint(255 * np.stack(cuts)).astype(np.uint8)


def write_video(path: Path, frames: UInt8[np.ndarray, "n h w c"]) -> None:
    """Write BGR or grey frames as MPEG-4."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, (WIDTH, HEIGHT))
    for frame in frames:
        video.write(np.ascontiguousarray(np.broadcast_to(frame, (HEIGHT, WIDTH, 3))))
    video.release()


def samples(folder: Path) -> dict[str, list[str]]:
    """Make a sample of each kind in `folder`; the words of the command for each."""
    photo = next(photo for photo in BUILTIN_PHOTOS if photo.path.stem == PHOTO)
    rgb = read_rgb(photo.path)
    colours = clip_of(rgb.permute(1, 2, 0).numpy())[..., ::-1]
    cv2.imwrite(str(folder / "photograph.png"), np.rint(255 * rgb.permute(1, 2, 0).numpy())[..., ::-1].astype(np.uint8))
    write_video(folder / "video.mp4", colours)
    write_video(folder / "grey.mp4", cv2.cvtColor(colours.reshape(-1, WIDTH, 3), cv2.COLOR_BGR2GRAY).reshape(
        FRAMES, HEIGHT, WIDTH, 1))  # fmt: skip
    for name in ("frames", "angles"):
        (folder / name).mkdir()
    angles = clip_of(intensities_from_stokes(scene_from_rgb(rgb).stokes).permute(1, 2, 0).numpy())
    mosaic = np.empty((FRAMES, HEIGHT, WIDTH, 1), np.uint8)
    for number, (angle, (row, column)) in enumerate(
        zip(POLARIZER_ANGLES_DEG, places_of(parse_mosaic(MOSAIC)), strict=True)
    ):
        write_video(folder / f"polarized_{angle}.mp4", angles[..., number : number + 1])
        mosaic[:, row::2, column::2, 0] = angles[:, row::2, column::2, number]
        for k, frame in enumerate(angles):
            cv2.imwrite(str(folder / "angles" / f"{k}_{angle}.png"), frame[..., number])
    write_video(folder / "mosaic.mp4", mosaic)
    for k, frame in enumerate(colours):
        cv2.imwrite(str(folder / "frames" / f"{k}.png"), frame)
    rate = ["--fps", str(RATE_HZ)]
    return {
        "photograph": ["photograph.png"],
        "RGB video": ["video.mp4"],
        "RGB video, upsampled": ["video.mp4", "--upsample"],
        "grey video": ["grey.mp4", "--grey"],
        "folder of RGB frames": ["frames", *rate],
        "four videos": [f"polarized_{angle}.mp4" for angle in POLARIZER_ANGLES_DEG],
        "folder of four angles": ["angles", *rate],
        "DoFP video": ["mosaic.mp4", "--mosaic", MOSAIC],
    }


def run_of(words: list[str], folder: Path) -> dict[str, Any]:
    """Events, seconds and events/s of the second run of the command."""
    command = ["simulate", *words, "--out", str(folder / "out"), "--no-preview"]
    for _ in range(2):
        started = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            if polarnet(command):
                raise RuntimeError(f"polarnet {' '.join(command)} failed")
        seconds = time.perf_counter() - started
    store = EventStore.open(folder / "out" / "events.zarr")
    events = sum(store.count(store.sequences[0]))
    return {
        "channel": [store.height, store.width],
        "events": events,
        "seconds": round(seconds, 3),
        "events_per_s": round(events / seconds),
    }


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/camera.json")
    parser.add_argument("--picture", action="store_true", help="draw docs/pictures/simulate.png")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        kinds = samples(Path(name))
        if arguments.picture:
            polarnet(["simulate", "video.mp4", "--upsample", "--out", "picture"])
            shutil.copy("picture/preview.png", ROOT / "docs" / "pictures" / "simulate.png")
            return
        rows = {}
        for kind, words in kinds.items():
            rows[kind] = run_of(words, Path(name))
            print(kind, json.dumps(rows[kind]), flush=True)
    section = {"count": len(rows), "frames": FRAMES, "frame_rate_hz": RATE_HZ, "inputs": rows}
    if arguments.write:
        path = write_section(ROOT, "camera", "simulate_inputs", section, record)
        print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
