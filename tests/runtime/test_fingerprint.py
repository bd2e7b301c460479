import dataclasses
import shutil

import pytest

from polarnet.methods import METHODS
from polarnet.methods.complementary_filter import filtered, open_cf
from polarnet.methods.method import Method, Setup
from polarnet.methods.stokes_gain import GainConfig
from polarnet.runtime.fingerprint import _normalised, code_digest, method_digest, reach, value_digest


def plain(setup):
    return filtered(None, setup.gain)


def digests(context):
    return {name: method_digest(method.open, context.setup_of(method)) for name, method in METHODS.items()}


def test_a_method_depends_on_the_fields_it_names_and_on_no_other():
    assert reach(METHODS["cf"].open, Setup).fields == ["config"]
    assert {"config", "gain"} <= set(reach(METHODS["cf+gain"].open, Setup).fields)
    assert not {"weights", "precision"} & set(reach(METHODS["cf+gain"].open, Setup).fields)
    assert {"weights", "precision"} <= set(reach(METHODS["ours"].open, Setup).fields)
    assert not {"config", "gain", "postprocessing"} & set(reach(METHODS["ours"].open, Setup).fields)
    assert reach(plain, Setup).fields == ["gain"]


@pytest.mark.parametrize(
    ("change", "changed"),
    [
        ({"precision": "bf16"}, {name for name, method in METHODS.items() if method.weights is not None}),
        ({"gain": GainConfig(3, 5, 20_000, 0.1, 0.0)}, {name for name, method in METHODS.items() if method.wraps}),
    ],
)
def test_a_setting_changes_the_digest_of_the_methods_that_use_it(context, make_context, change, changed):
    before, after = digests(context), digests(make_context(**dict.fromkeys(context.setups, change)))
    assert {name for name in METHODS if before[name] != after[name]} == changed


def test_new_weights_change_the_digest_of_their_method_alone(context, make_context, tmp_path):
    given, own = context.setups["ours"].weights, tmp_path / "ours.safetensors"
    shutil.copy(given, own)
    shutil.copy(given.with_suffix(".json"), own.with_suffix(".json"))
    context = make_context(ours={"weights": own})
    before = digests(context)
    content = bytearray(own.read_bytes())
    content[-1] ^= 1
    own.write_bytes(content)
    after = digests(context)
    assert {name for name in METHODS if before[name] != after[name]} == {"ours"}


def test_another_method_changes_no_digest(context, monkeypatch):
    before = digests(context)
    another = Method("plain", "plain", "#000000", plain)
    monkeypatch.setitem(METHODS, "plain", another)
    reach.cache_clear()
    context = dataclasses.replace(context, setups=context.setups | {"plain": context.setups["cf"]})
    assert {name: digest for name, digest in digests(context).items() if name != "plain"} == before


def test_code_counts_where_it_is_reached_comments_and_docstrings_do_not():
    text = 'def f(x):\n    """Doc."""\n    return x + 1  # why\n'
    assert _normalised(text) == _normalised("def f( x ):\n\n    return x+1\n")
    assert _normalised(text) != _normalised("def f(x):\n    return x + 2\n")
    modules = reach(METHODS["cf"].open, Setup).modules
    assert "polarnet.stokes" in modules
    assert "polarnet.networks.dolp_unet" not in modules
    assert "polarnet.networks.dolp_unet" in reach(METHODS["ours"].open, Setup).modules


def test_an_inner_function_counts_with_what_it_closes_over():
    assert code_digest(METHODS["cf+gain"].open) != code_digest(METHODS["highpass+gain"].open)
    assert code_digest(METHODS["cf"].open) == code_digest(open_cf)


def test_values_are_told_apart_by_type_and_content(tmp_path):
    file = tmp_path / "weights"
    absent = value_digest(file)
    file.write_bytes(b"1")
    values = [1, 1.0, "1", [1], {"1": 1}, None, file]
    assert len({value_digest(value) for value in values} | {absent}) == len(values) + 1
