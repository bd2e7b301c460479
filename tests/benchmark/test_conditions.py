import dataclasses

import pytest

from polarnet.analysis.conditions import conditions, sentence, trained_on, warnings
from polarnet.config.tree import load


@pytest.fixture(scope="module")
def config(project_root):
    return load(project_root)


def checkpoint(config, emulate):
    """Metadata of a training with the settings of `config` but for these of the sensor."""
    motion, sensor = config.synthesize, dataclasses.replace(config.emulate, **emulate)
    attributes = {"emulate": dataclasses.asdict(sensor), "scenes": {"synthesize": dataclasses.asdict(motion)}}
    return {"data": {"height": motion.sensor_height, "width": motion.sensor_width, "events_from": attributes}}


RANGE = {"randomise": {"cutoff_hz": [30.0, 300.0]}}
NAMES = {"randomise": {"model": ["exact", "v2e"], "contrast_threshold_mismatch_on": [0.1, 0.2]}}


@pytest.mark.parametrize(("synthesize", "emulate", "trained", "said"), [
    ({}, {}, {}, None),
    ({"sensor_height": 60, "duration_s": 0.4}, {}, {},
     "synthesize.duration_s 0.4 (training: 1.0), synthesize.sensor_height 60 (training: 120)."),
    ({"sequences_per_picture": 3}, {"leak_rate_hz": 5.0}, {}, "emulate.leak_rate_hz 5.0 (training: 0.01)."),
    ({"speed_min_px_s": 50.0}, {}, {}, None),
    ({"speed_max_px_s": 500.0}, {}, {}, "synthesize.speed_max_px_s 500.0 (training: 160.0)."),
    ({}, {"cutoff_hz": 400.0}, RANGE, "emulate.cutoff_hz 400.0 (training: [30.0, 300.0])."),
    ({}, {"contrast_threshold_mismatch_on": 0.15}, NAMES, None),
    ({}, {"model": "esim"}, NAMES, "emulate.contrast_threshold_mismatch_on null (training: [0.1, 0.2]), "
     'emulate.model "esim" (training: ["exact", "v2e"]).'),
    ({}, RANGE, {}, 'emulate.randomise {"cutoff_hz": [30.0, 300.0]} (training: null).'),
])  # fmt: skip
def test_a_difference_from_the_training_is_said_with_both_values(config, synthesize, emulate, trained, said):
    motion, sensor = (
        dataclasses.replace(config.synthesize, **synthesize), dataclasses.replace(config.emulate, **emulate)
    )  # fmt: skip
    metadata = checkpoint(config, trained)
    lines = warnings(conditions(motion, sensor), {"ours": metadata, "e2v": metadata})
    if said is None:
        assert lines == []
    else:
        (line,) = lines
        assert line.startswith(f"ours, e2v: these sequences differ from those of its training: {said} Give")


def test_size_duration_rate_and_model_are_said_and_a_checkpoint_that_says_nothing_is_named(config):
    used = conditions(config.synthesize, config.emulate)
    about = "Sequences of 120x180 pixels (height x width), 1 s at 30 frames a second; sensor: model exact."
    assert sentence(used) == about
    assert trained_on({"network": "paper"}) is None
    (line,) = warnings(used, {"ours": {}})
    assert "does not say what it was trained on" in line
