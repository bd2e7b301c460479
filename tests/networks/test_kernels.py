"""The compiled kernels against the torch code, which defines them and runs where gradients are recorded."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import pytest
import torch
from test_stokes_unet import network
from torch import Tensor
from torch.nn import functional as F

from polarnet.config.tree import load
from polarnet.networks.polarnet import kernels

CONFIG = replace(load(Path(__file__).resolve().parents[2]).networks.polarnet, channels=[8, 8, 8])
SIZES = [(40, 72), (37, 70), (5, 3)]


def counts(height: int, width: int, windows: int = 4) -> Tensor:
    """Counts of a random picture that moves left by two pixels a window, and of independent ones: [t, 1, 8, h, w]."""
    generator = torch.Generator().manual_seed(1)
    picture = torch.randn(1, 4, height // 4 + 1, width // 4 + windows + 1, generator=generator)
    picture = 4 * F.interpolate(picture, scale_factor=4, mode="bilinear")[0]
    views = torch.stack([picture[:, :height, 2 * k : 2 * k + width] for k in range(windows + 1)])
    polarity = views.diff(dim=0).round()
    more = torch.poisson(torch.full_like(polarity, 0.3), generator)
    return torch.stack([polarity, polarity.abs() + 2 * more], dim=2).flatten(1, 2)[:, None]


def tensors(value: Any) -> Iterator[Tensor]:
    """All tensors of nested tuples and lists, in order."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from tensors(item)


def assert_close(compiled: Any, defined: Any) -> None:
    for one, other in zip(tensors(compiled), tensors(defined), strict=True):
        size = float(other.detach().abs().max())
        torch.testing.assert_close(one, other.detach(), atol=1e-5 * size, rtol=1e-5)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("changes", [{}, {"binning": 2}, {"without": ["sensitivity"]}], ids=str)
def test_maps_and_states_of_the_kernels_are_those_of_the_torch_code(size, changes):
    built, windows = network(CONFIG, **changes), counts(*size)
    state: list[Tensor] = []
    for inputs in windows.split(2):
        defined, defined_state = built.unroll(inputs, state)
        with torch.no_grad():
            compiled, compiled_state = built.unroll(inputs, state)
        assert_close(compiled._replace(aolp=None), defined._replace(aolp=None))  # an angle jumps from pi to 0
        assert_close(compiled_state, defined_state)
        state = [tensor.detach() for tensor in defined_state]


@torch.no_grad()
def test_the_kernels_give_the_same_bytes_on_any_number_of_threads():
    built, before = network(CONFIG), numba.get_num_threads()
    results = []
    for threads in {1, before}:
        numba.set_num_threads(threads)
        results.append([*tensors(built.solve_windows(counts(40, 72), []))])
    numba.set_num_threads(before)
    for one, other in zip(results[0], results[-1], strict=True):
        assert torch.equal(one, other)


def test_images_in_bfloat16_are_the_rounded_ones_and_kernels_run_without_gradients_on_float32_only():
    built, inputs = network(CONFIG), counts(40, 72, windows=1)
    polarity, count = inputs.unflatten(2, (4, 2)).unbind(3)
    with torch.no_grad():
        _, _, images = built._event_sums(polarity, count, torch.ones(1, 1, 1, 1), None)
        with torch.autocast("cpu", torch.bfloat16):
            _, _, rounded = built._event_sums(polarity, count, torch.ones(1, 1, 1, 1), None)
    assert torch.equal(rounded, images.to(torch.bfloat16))
    with torch.no_grad():
        assert kernels.compiled_path(torch.zeros(1))
        assert not kernels.compiled_path(torch.zeros(1, dtype=torch.float64))
        assert not kernels.compiled_path(torch.zeros(1, device="meta"))
    assert not kernels.compiled_path(torch.zeros(1))
