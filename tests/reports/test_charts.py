from polarnet.reports.artefacts import BudgetPoint, History
from polarnet.reports.charts import budget_chart, scatter_chart, score_chart, spread_chart, term_label, training_chart
from polarnet.reports.legend import GENERAL
from polarnet.reports.tables import COLUMNS

METRICS = {
    "oracle_mean": {"mse": 0.03, "mse_ci": [0.02, 0.04], "psnr": 15.0},
    "ours": {"mse": 0.02, "mse_ci": [0.01, 0.03], "psnr": None},
}
MEANS = {"cf": {"lake": 0.2, "park": 0.1}, "ours": {"lake": 0.02, "park": 0.03}}


def values(spec, layer=None):
    """Data of a specification, or of one of its layers."""
    part = spec if layer is None else spec["layer"][layer]
    return part.get("data", spec.get("data"))["values"]


def test_a_score_keeps_its_interval_and_a_missing_score_is_left_out():
    data = values(score_chart(METRICS, {key: COLUMNS[key] for key in ("mse", "psnr")}, GENERAL))
    ours = [value for value in data if value["method"] == GENERAL.label("ours")]
    assert [(one["value"], one["low"], one["high"]) for one in ours] == [(0.02, 0.01, 0.03)]
    assert len(data) == 3


def test_every_scene_of_every_rival_is_a_dot_beside_ours():
    spec = scatter_chart(MEANS, GENERAL)
    dots = values(spec, 1)
    assert {(one["scene"], one["other"], one["ours"]) for one in dots} == {("lake", 0.2, 0.02), ("park", 0.1, 0.03)}
    assert scatter_chart({"ours": MEANS["ours"]}, GENERAL) is None


def test_the_spread_names_every_scene():
    assert len(values(spread_chart(MEANS, GENERAL))) == 4


def test_a_method_keeps_its_colour_in_the_event_budget_and_zero_events_have_no_place_on_its_axis():
    points = [BudgetPoint("ours", 0.0, 0.3, 1), BudgetPoint("ours", 2.0, 0.1, 4), BudgetPoint("cf", 2.0, 0.2, 4)]
    spec = budget_chart(points, GENERAL)
    assert [one["events_per_pixel"] for one in values(spec)] == [2.0, 2.0]
    scale = spec["encoding"]["color"]["scale"]
    assert dict(zip(scale["domain"], scale["range"], strict=True))[GENERAL.label("ours")] == GENERAL.colour("ours")


def test_epochs_count_from_one():
    loss, psnr = training_chart(History("polarnet", {"mse": [0.3, 0.1]}, {"psnr": [9.0, 10.0]}, 1), "DoLP")
    assert [value["epoch"] for value in values(loss)] == [1, 2]
    assert [value["psnr"] for value in values(psnr)] == [9.0, 10.0]


def test_every_term_of_the_losses_has_a_readable_name():
    terms = ["total", "mse", "mae", "ssim_loss", "lpips", "stokes", "intensity_lpips", "aolp_ssim_loss"]
    labels = [term_label(term) for term in terms]
    assert labels[-2:] == ["intensity: LPIPS", "AoLP: 1 - SSIM"]
    assert not [label for label in labels if "_" in label]
