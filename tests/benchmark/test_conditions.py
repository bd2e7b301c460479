import dataclasses

import pytest

from polarnet.analysis.conditions import configured, sentence, stored, trained_on, warnings
from polarnet.config.tree import load


@pytest.fixture(scope="module")
def config(project_root):
    return load(project_root)


def checkpoint(config, synthesize, emulate):
    """Metadata of a training with the settings of `config` but for these."""
    motion, sensor = (
        dataclasses.replace(config.synthesize, **synthesize),
        dataclasses.replace(config.emulate, **emulate),
    )
    attributes = {"emulate": dataclasses.asdict(sensor), "scenes": {"synthesize": dataclasses.asdict(motion)}}
    return {"data": {"height": motion.sensor_height, "width": motion.sensor_width, "events_from": attributes}}


@pytest.mark.parametrize(("emulate", "parts", "left_out"), [
    ({}, ["Sequences of 120x180 pixels (height x width), 1 s at 30 frames a second; sensor: model exact",
          "contrast thresholds 0.2 (ON) and 0.2 (OFF), mismatch 0.03 (ON) and 0.03 (OFF), cutoff 300 Hz"], "drawn"),
    ({"model": "esim"}, ["refractory period 500 us"], "cutoff"),
    ({"model": "dvs_voltmeter"}, ["model dvs_voltmeter with the constants of dvs346."], "cutoff"),
    ({"randomise": {"cutoff_hz": [30.0, 300.0], "leak_rate_hz": [0.01, 0.1]}},
     ["model exact, cutoff_hz, leak_rate_hz drawn for each sequence (emulate.randomise)."], "300 Hz"),
])  # fmt: skip
def test_size_duration_rate_and_the_parameters_that_the_sensor_model_has_are_said(config, emulate, parts, left_out):
    text = sentence(configured(config.synthesize, dataclasses.replace(config.emulate, **emulate)))
    assert all(part in text for part in parts)
    assert left_out not in text


RANGE = {"randomise": {"cutoff_hz": [30.0, 300.0]}}
NAMES = {"randomise": {"model": ["exact", "v2e"], "voltmeter_camera": ["dvs240"]}}


@pytest.mark.parametrize(("synthesize", "emulate", "trained", "said"), [
    ({}, {}, {}, None),
    ({"sensor_height": 60, "duration_s": 0.4}, {}, {},
     "these sequences differ from those of its training: synthesize.duration_s 0.4 (training: 1.0), "
     "synthesize.sensor_height 60 (training: 120). Set synthesize.duration_s=1.0 synthesize.sensor_height=120"),
    # parameters that the model does not use and more sequences are no difference
    ({"sequences_per_picture": 3}, {"shot_noise_rate_hz": 5.0, "esim_log_eps": 0.1}, {},
     "emulate.shot_noise_rate_hz 5.0 (training: 0.001). Set emulate.shot_noise_rate_hz=0.001"),
    ({"speed_min_px_s": 50.0}, {}, {}, None),
    ({}, {}, RANGE, None),
    ({}, {"cutoff_hz": 400.0}, RANGE,
     "emulate.cutoff_hz 400.0 (training: [30.0,300.0]). Set emulate.cutoff_hz=300.0"),
    ({}, {}, NAMES, None),
    ({}, {"model": "esim"}, NAMES, "Set emulate.model=exact"),
    ({}, RANGE, {}, "emulate.randomise {cutoff_hz:[30.0,300.0]} (training: null)"),
])  # fmt: skip
def test_a_difference_from_the_training_is_said_with_both_values_and_what_to_set(
    config, synthesize, emulate, trained, said
):
    used = configured(
        dataclasses.replace(config.synthesize, **synthesize), dataclasses.replace(config.emulate, **emulate)
    )
    metadata = checkpoint(config, {}, trained)
    lines = warnings(used, {"ours": metadata, "e2v": metadata}, "Set")
    if said is None:
        assert lines == []
    else:
        (line,) = lines
        assert line.startswith("ours, e2v: ")
        assert said in line


def test_a_checkpoint_that_says_nothing_is_named_and_of_recorded_events_the_size_alone_is_known(config):
    assert trained_on({"network": "paper"}) is None
    (line,) = warnings(configured(config.synthesize, config.emulate), {"ours": {}}, "Set")
    assert "does not say what it was trained on" in line
    recorded = stored({}, 120, 180)
    assert sentence(recorded) == "Sequences of 120x180 pixels (height x width)."
    assert warnings(recorded, {"ours": checkpoint(config, {}, {})}, "Set") == []
