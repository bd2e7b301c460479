import torch

from polarnet.reports.artefacts import read_results, training_history
from polarnet.storage.frames import FrameStore


def test_a_panel_holds_the_truth_of_the_window_it_names(data, paths):
    for panel in read_results(paths.simulated).panels:
        frames = FrameStore.open(data / "frames.zarr").frames(panel.sequence)
        assert int(frames.t_us[panel.window + 1]) == panel.t_us
        assert torch.equal(frames.dolp[panel.window + 1], panel.truth.dolp)
        assert set(panel.predictions) == {"zeros", "oracle_mean", "e2v", "ours"}
        assert [row for row, one in panel.predictions.items() if one.aolp is not None] == ["e2v"]


def test_the_best_epoch_is_the_one_with_the_lowest_validation_mse(paths):
    history = training_history(paths.train / "ours")
    assert history.best_epoch == 1
    assert list(history.loss) == ["total", "mse"]
    assert history.validation["psnr"] == [10.0, 11.0, 12.0]
