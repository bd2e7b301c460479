import dataclasses
import shutil

import pytest

from polarnet.baselines.stokes_gain import GainConfig
from polarnet.evaluation import methods
from polarnet.evaluation.methods import GAIN, METHODS, NEEDED, Context, Polarization
from polarnet.fingerprint import _normalised, code_digest, method_digest, reach, value_digest


def plain(recording, context):
    return Polarization(recording.dolp * context.train_mean)


def test_a_method_depends_on_the_fields_it_names_and_on_no_other(context):
    assert reach(METHODS["cf"], Context).fields == ["cf"]
    assert reach(METHODS["zeros"], Context).fields == []
    assert "ours_checkpoint" in reach(METHODS["ours"], Context).fields  # by way of Context.ours
    assert "e2v_checkpoint" not in reach(METHODS["ours"], Context).fields
    assert reach(plain, Context).fields == ["train_mean"]


@pytest.mark.parametrize(
    ("change", "changed"),
    [
        ({"train_mean": 0.5}, {"train_mean"}),
        ({"precision": "bf16"}, {name for name in METHODS if name.removesuffix(GAIN) in NEEDED}),
        ({"gain": GainConfig(3, 5, 20_000, 0.1, 0.0)}, {name for name in METHODS if name.endswith(GAIN)}),
    ],
)
def test_a_setting_changes_the_digest_of_the_methods_that_use_it(context, change, changed):
    other = dataclasses.replace(context, **change)
    found = {name for name, m in METHODS.items() if method_digest(m, context) != method_digest(m, other)}
    assert found == changed


def test_new_weights_change_the_digest_of_their_method_alone(context, tmp_path):
    own = tmp_path / "ours.safetensors"
    shutil.copy(context.ours_checkpoint, own)
    shutil.copy(context.ours_checkpoint.with_suffix(".json"), own.with_suffix(".json"))
    context = dataclasses.replace(context, ours_checkpoint=own)
    before = {name: method_digest(method, context) for name, method in METHODS.items()}
    content = bytearray(context.ours_checkpoint.read_bytes())
    content[-1] ^= 1
    context.ours_checkpoint.write_bytes(content)
    assert {name for name, method in METHODS.items() if method_digest(method, context) != before[name]} == {"ours"}


def test_another_method_changes_no_digest(context, monkeypatch):
    before = {name: method_digest(method, context) for name, method in METHODS.items()}
    monkeypatch.setitem(METHODS, "plain", plain)
    reach.cache_clear()
    assert {name: method_digest(METHODS[name], context) for name in before} == before


def test_code_counts_where_it_is_reached_comments_and_docstrings_do_not():
    text = 'def f(x):\n    """Doc."""\n    return x + 1  # why\n'
    assert _normalised(text) == _normalised("def f( x ):\n\n    return x+1\n")
    assert _normalised(text) != _normalised("def f(x):\n    return x + 2\n")
    modules = reach(METHODS["cf"], Context).modules
    assert {"polarnet.baselines.complementary_filter", "polarnet.stokes"} <= modules
    assert "polarnet.networks.dolp_unet" not in modules
    assert "polarnet.networks.dolp_unet" in reach(METHODS["ours"], Context).modules


def test_an_inner_function_counts_with_what_it_closes_over():
    assert code_digest(METHODS["cf"]) != code_digest(METHODS["highpass"])
    assert code_digest(methods.from_intensities(methods.cf_intensities)) == code_digest(METHODS["cf"])


def test_values_are_told_apart_by_type_and_content(tmp_path):
    file = tmp_path / "weights"
    absent = value_digest(file)
    file.write_bytes(b"1")
    values = [1, 1.0, "1", [1], {"1": 1}, None, file]
    assert len({value_digest(value) for value in values} | {absent}) == len(values) + 1
