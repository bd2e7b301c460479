"""Ctrl-C ends a command with one line, status 130 and work that a rerun continues."""

import os
import signal
import subprocess
import sys
import time

import pytest
from skimage import data, io

from polarnet.terminal.environment import STOPPED, UNWINDING_S


def heed_interrupts() -> None:
    """Undo what a shell sets for commands in its background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def interrupted(command, folder, ready, project_root):
    """Status, as a shell gives it, and standard error of a command that gets SIGINT once `ready()` is true."""
    environment = os.environ | {"PYTHONPATH": str(project_root)}
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                          env=environment, start_new_session=True, preexec_fn=heed_interrupts) as process:  # fmt: skip
        while not ready():
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it, to all processes of the command
        _, error = process.communicate(timeout=60)
    if process.returncode == -signal.SIGINT:  # Python's own end where the interrupt fell into code from a string
        return 128 + signal.SIGINT, error
    return process.returncode, error


@pytest.mark.thorough
def test_a_benchmark_stops_in_one_line_and_a_rerun_continues(tmp_path, project_root):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in ("coffee", "astronaut", "rocket"):
        io.imsave(photographs / f"{name}.png", getattr(data, name)()[:200, :300], check_contrast=False)
    work = tmp_path / "out" / "work" / "set"
    command = [sys.executable, "-m", "polarnet.cli", "benchmark", "--scenes", "photographs", "--out", "out",
               "--methods", "cf", "benchmark.lpips=false", "synthesize.duration_s=0.3", "synthesize.sensor_height=60",
               "synthesize.sensor_width=90", "runtime.workers=2"]  # fmt: skip
    status, error = interrupted(command, tmp_path, (work / "images" / "manifest.json").exists, project_root)
    assert status == 130
    assert "Traceback" not in error
    assert error.rstrip().endswith(
        "polarnet benchmark: stopped; finished work is kept, and the same command again continues from it"
    )
    before = (work / "images" / "manifest.json").stat().st_mtime_ns
    again = [*command, "runtime.workers=1"]  # the same but for the start of two processes
    assert subprocess.run(again, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(project_root)}).returncode == 0
    assert (work / "images" / "manifest.json").stat().st_mtime_ns == before


UNWINDING = """
import sys, time
from polarnet.terminal.environment import announce_interrupts
announce_interrupts()
try:
    open(sys.argv[1], "w").close()
    time.sleep(60)
finally:
    open(sys.argv[2], "w").close()
    time.sleep(float(sys.argv[3]))
    print("unwound")
"""


@pytest.mark.thorough
@pytest.mark.parametrize(("seconds", "unwound"), [(1.0, True), (60.0, False)])
def test_a_second_interrupt_ends_only_what_hangs_after_the_first(tmp_path, project_root, seconds, unwound):
    started, ending = tmp_path / "started", tmp_path / "ending"
    command = [sys.executable, "-c", UNWINDING, str(started), str(ending), str(seconds)]
    with subprocess.Popen(command, cwd=project_root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          preexec_fn=heed_interrupts) as process:  # fmt: skip
        for file in (started, ending):
            while not file.exists():
                assert process.poll() is None
                time.sleep(0.02)
            process.send_signal(signal.SIGINT)
        if not unwound:
            time.sleep(UNWINDING_S + 0.5)
            process.send_signal(signal.SIGINT)
        output, error = process.communicate(timeout=30)
    assert output == ("unwound\n" if unwound else "")
    assert error == (f"{STOPPED}\n" if unwound else "")


HALF_MADE = """
import sys, time
from polarnet.terminal.environment import announce_interrupts
announce_interrupts()
def reach(place):
    if place == sys.argv[2]:
        open(sys.argv[1], "w").close()
        time.sleep(60)
class Loop:
    def __init__(self):
        reach("construction")
        self.socket = "open"
    def __del__(self):
        reach("destruction")
        del self.socket
loop = Loop()
del loop
time.sleep(60)
"""


@pytest.mark.parametrize("place", ["construction", "destruction"])
def test_an_interrupt_in_a_constructor_or_destructor_ends_the_program_in_one_line(tmp_path, project_root, place):
    started = tmp_path / "started"
    command = [sys.executable, "-c", HALF_MADE, str(started), place]
    assert interrupted(command, tmp_path, started.exists, project_root) == (130, f"{STOPPED}\n")
