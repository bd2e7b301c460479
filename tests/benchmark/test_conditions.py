import dataclasses

import pytest

from polarnet.analysis.conditions import configured, sentence, stored, trained_on, warnings
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
    assert "contrast thresholds 0.2 (ON) and 0.2 (OFF), mismatch 0.03 (ON) and 0.03 (OFF), cutoff 300 Hz" in text


def test_a_model_is_described_by_the_parameters_that_it_has(config):
    esim = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, model="esim")))
    assert "cutoff" not in esim
    assert "refractory period 500 us" in esim
    voltmeter = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, model="dvs_voltmeter")))
    assert voltmeter.endswith("model dvs_voltmeter with the constants of dvs346.")
    emulate = dataclasses.replace(config.emulate, randomise={"cutoff_hz": [30.0, 300.0], "leak_rate_hz": [0.01, 0.1]})
    drawn = sentence(configured(config.synthesize, emulate))
    assert drawn.endswith("model exact, cutoff_hz, leak_rate_hz drawn for each sequence (emulate.randomise).")


def test_a_difference_is_said_with_both_values_and_what_to_set(config):
    used = configured(dataclasses.replace(config.synthesize, sensor_height=60, duration_s=0.4), config.emulate)
    assert warnings(used, {"ours": checkpoint(config), "e2v": checkpoint(config)}, "Set") == [
        "ours, e2v: these sequences differ from those of its training: synthesize.duration_s 0.4 (training: 1.0), "
        "synthesize.sensor_height 60 (training: 120). Set synthesize.duration_s=1.0 synthesize.sensor_height=120"
    ]


def test_another_sensor_is_a_difference_but_unused_parameters_and_more_sequences_are_none(config):
    noisy = dataclasses.replace(config.emulate, shot_noise_rate_hz=5.0, esim_log_eps=0.1)
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


def drawn(config, **ranges):
    """Metadata of a training whose sequences drew their sensors."""
    return checkpoint(dataclasses.replace(config, emulate=dataclasses.replace(config.emulate, randomise=ranges)))


def test_a_sensor_and_a_speed_within_the_ranges_of_the_training_are_no_difference(config):
    trained = {"ours": drawn(config, cutoff_hz=[30.0, 300.0])}
    assert warnings(configured(config.synthesize, config.emulate), trained, "Set") == []
    slower = dataclasses.replace(config.synthesize, speed_min_px_s=50.0)
    assert warnings(configured(slower, config.emulate), {"ours": checkpoint(config)}, "Set") == []


def test_a_sensor_beyond_the_ranges_of_the_training_is_said_with_the_range_and_the_nearest_value(config):
    trained = {"ours": drawn(config, cutoff_hz=[30.0, 300.0])}
    other = dataclasses.replace(config.emulate, cutoff_hz=400.0)
    (line,) = warnings(configured(config.synthesize, other), trained, "Set")
    assert line.endswith("emulate.cutoff_hz 400.0 (training: [30.0,300.0]). Set emulate.cutoff_hz=300.0")


def test_a_pixel_model_is_compared_with_the_names_that_the_training_drew(config):
    trained = {"ours": drawn(config, model=["exact", "v2e"], voltmeter_camera=["dvs240"])}
    assert warnings(configured(config.synthesize, config.emulate), trained, "Set") == []
    esim = dataclasses.replace(config.emulate, model="esim")
    (line,) = warnings(configured(config.synthesize, esim), trained, "Set")
    assert "emulate.model esim (training: [exact,v2e])" in line
    assert line.endswith("Set emulate.model=exact")


def test_a_drawn_sensor_is_a_difference_for_a_training_that_drew_none_and_its_own_conditions_are_none(config):
    assert warnings(configured(config.synthesize, config.emulate), {"ours": checkpoint(config)}, "Set") == []
    random = dataclasses.replace(config.emulate, randomise={"cutoff_hz": [30.0, 300.0]})
    (line,) = warnings(configured(config.synthesize, random), {"ours": checkpoint(config)}, "Set")
    assert "emulate.randomise {cutoff_hz:[30.0,300.0]} (training: null)" in line
