import dataclasses

import pytest

from polarnet.benchmark.conditions import configured, sentence, stored, trained_on, warnings
from polarnet.config.tree import load


@pytest.fixture(scope="module")
def config(project_root):
    return load(project_root)


def checkpoint(config, **synthesize):
    """Metadata of a training with the settings of `config` but for these."""
    motion = dataclasses.replace(config.synthesize, **synthesize)
    scenes = {"synthesize": dataclasses.asdict(motion)}
    attributes = {"emulate": dataclasses.asdict(config.emulate), "scenes": scenes}
    return {"data": {"height": motion.sensor_height, "width": motion.sensor_width, "events_from": attributes}}


def test_size_duration_rate_and_sensor_are_said(config):
    text = sentence(configured(config.synthesize, config.emulate))
    assert text.startswith(
        "Sequences of 120x180 pixels (height x width), 1 s at 30 frames a second; sensor: model exact"
    )
    assert "contrast thresholds 0.2 (ON) and 0.2 (OFF), mismatch 0.03, cutoff 300 Hz" in text


def test_a_model_is_described_by_the_parameters_that_it_has(config):
    esim = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, model="esim")))
    assert "cutoff" not in esim
    assert "refractory period 500 us" in esim
    voltmeter = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, model="dvs_voltmeter")))
    assert voltmeter.endswith("model dvs_voltmeter with the constants of dvs346.")
    drawn = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, randomise=True)))
    assert "drawn for each sequence" in drawn
    assert "thresholds" not in drawn


def test_the_conditions_of_the_training_give_no_warning(config):
    assert warnings(configured(config.synthesize, config.emulate), {"ours": checkpoint(config)}, "Set") == []


def test_a_difference_is_said_with_both_values_and_what_to_set(config):
    used = configured(dataclasses.replace(config.synthesize, sensor_height=60, duration_s=0.4), config.emulate)
    assert warnings(used, {"ours": checkpoint(config), "e2v": checkpoint(config)}, "Set") == [
        "ours, e2v: these sequences differ from those of its training: synthesize.duration_s 0.4 (training: 1.0), "
        "synthesize.sensor_height 60 (training: 120). Set synthesize.duration_s=1.0 synthesize.sensor_height=120"
    ]


def test_another_sensor_is_a_difference_but_unused_parameters_and_more_sequences_are_none(config):
    noisy = dataclasses.replace(config.emulate, shot_noise_rate_hz=5.0, esim_log_eps=0.1, random_cutoff_hz=[1.0, 2.0])
    motion = dataclasses.replace(config.synthesize, sequences_per_picture=3)
    (line,) = warnings(configured(motion, noisy), {"ours": checkpoint(config)}, "Set")
    assert line.endswith("emulate.shot_noise_rate_hz 5.0 (training: 0.001). Set emulate.shot_noise_rate_hz=0.001")


def test_a_checkpoint_that_says_nothing_is_named(config):
    assert trained_on({"network": "paper"}) is None
    (line,) = warnings(configured(config.synthesize, config.emulate), {"ours": {}}, "Set")
    assert "does not say what it was trained on" in line


def test_of_events_that_were_not_simulated_the_size_alone_is_known(config):
    recorded = stored({}, 120, 180)
    assert sentence(recorded) == "Sequences of 120x180 pixels (height x width)."
    assert warnings(recorded, {"ours": checkpoint(config)}, "Set") == []
