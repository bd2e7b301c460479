import pytest
import torch

from polarnet.analysis.between_windows import frames_between
from polarnet.benchmark.rows import opened, run
from polarnet.config.tree import load
from polarnet.methods import METHODS


@pytest.fixture
def between(project_root):
    return load(project_root).between


def test_a_sequence_has_frames_at_ends_of_windows_and_at_other_times(sequence, context, between):
    recoverer = opened(METHODS["ours"], context)
    ends = sequence.t_us[1:].tolist()
    middle = (ends[0] + ends[1]) // 2
    frames = frames_between(sequence, [ends[0], middle, ends[1], ends[-1] + 100], recoverer, between)
    torch.testing.assert_close(frames.at_ends.dolp, run(recoverer, sequence.windows).dolp.cpu())
    assert torch.equal(frames.carried.dolp[[0, 2]], frames.at_ends.dolp[:2])
    assert torch.equal(frames.held.dolp, frames.at_ends.dolp[[0, 0, 1, -1]])


def test_times_before_the_first_frame_are_refused(sequence, context, between):
    first = int(sequence.t_us[1])
    with pytest.raises(ValueError, match=f"expected times from the end of the first window, {first} us, got 5 us"):
        frames_between(sequence, [5], opened(METHODS["ours"], context), between)
