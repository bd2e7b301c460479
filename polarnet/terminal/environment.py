"""Environment, Ctrl-C and quiet libraries in polarnet's programs; importing polarnet elsewhere changes none of them."""

import atexit
import os
import signal
import sys
import time
import warnings
from types import FrameType, TracebackType

INTERRUPTED = 130  # exit status of shells after Ctrl-C
UNWINDING_S = 3.0  # after Ctrl-C, in which another one is ignored; later, it ends the program at once
STOPPED = "stopped; finished work is kept, and the same command again continues from it"


def let_threads_sleep() -> None:
    """Let waiting OpenMP threads sleep soon instead of taking cores from others; call this before anything loads torch.

    Not at once, because a network is many short operations. Variables that are set already stay.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # turns of a loop


def announce_interrupts() -> None:
    """Let Ctrl-C end this program with the one line `STOPPED` instead of a traceback, even during its imports.

    A program that was started with SIGINT ignored, as `nohup` and worker pools do, goes on ignoring it.
    """

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print(STOPPED, file=sys.stderr)
        else:
            sys.__excepthook__(kind, error, trace)

    def end(failure: "sys.UnraisableHookArgs") -> None:
        if failure.exc_type is KeyboardInterrupt:  # it fell into a destructor, where Python would drop it
            print(STOPPED, file=sys.stderr)
            os._exit(INTERRUPTED)

    def interrupt(number: int, frame: FrameType | None) -> None:
        first = time.monotonic()
        signal.signal(signal.SIGINT, lambda *_: time.monotonic() > first + UNWINDING_S and os._exit(INTERRUPTED))
        sys.unraisablehook = end  # quiet about what the interrupt leaves half made, such as an event loop of Zarr
        warnings.simplefilter("ignore", RuntimeWarning)  # and about a coroutine of Zarr that was to start
        raise KeyboardInterrupt

    sys.excepthook = hook
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def silence_bindings() -> None:
    """Discard output of C++ libraries after Python's end, such as nanobind's lists of leaks, which no setting stops."""
    atexit.register(lambda: os.dup2(os.open(os.devnull, os.O_WRONLY), 2))  # registered first, so it runs last
