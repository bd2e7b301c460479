import pytest

from polarnet.recordings.recording import read_recording


def columns_of(events):
    """Columns t, x, y and p as lists."""
    return [getattr(events, name).tolist() for name in "txyp"]


@pytest.fixture(scope="session")
def columns():
    return columns_of


@pytest.fixture(scope="session")
def read():
    """Read a file: its format, height and width, its columns, and its repairs."""

    def read_file(path, format=None, **arguments):
        recording = read_recording(path, format, **arguments)
        events = recording.events
        return (recording.format, events.height, events.width), columns_of(events), recording.repairs

    return read_file
