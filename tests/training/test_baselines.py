from polarnet.methods import METHODS
from polarnet.training.baselines import BASELINES


def test_every_baseline_is_trained_for_a_method_and_every_trained_method_has_a_baseline():
    trainings = {method.weights.trained_by for method in METHODS.values() if method.weights is not None}
    assert trainings - {None, "ours"} == set(BASELINES)


def test_a_record_names_the_lpips_weights_among_its_settings():
    for baseline in BASELINES.values():
        assert set(baseline.lpips) <= set(baseline.config.__dataclass_fields__)
