"""Arrays of a caller's program: what is taken, and the sentence that each other kind is answered with."""

import warnings

import numpy as np
import pytest
import torch

from polarnet.runtime.arrays import as_tensor, check_shape, floats, fractions, mask_of, whole_numbers


def test_a_numpy_array_shares_its_memory_and_what_float32_leaves_outside_is_clipped():
    values = np.zeros((2, 3), np.float32)
    as_tensor("values", values)[1, 2] = 5
    assert values[1, 2] == 5
    values = torch.tensor([-1e-6, 0.0, 1e-30, 0.1, 1.0, 1 + 1e-6])
    assert fractions("light", values, "n").tolist() == [0.0, *values[1:5].tolist(), 1.0]


@pytest.mark.parametrize(
    "values",
    [
        np.arange(6.0)[::-1],
        np.arange(6.0, dtype=">f4"),
        np.arange(6.0, dtype=np.longdouble),
        np.broadcast_to(np.float32(1), (6,)),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    ],
    ids=["reversed", "big-endian", "long double", "read-only", "columns first"],
)
def test_the_layout_of_numpy_memory_does_not_matter(values):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert as_tensor("values", values).tolist() == values.tolist()


@pytest.mark.parametrize(
    ("values", "got"),
    [
        ([[0.1, 0.2]], "list"),
        ("coffee.png", "str"),
        (None, "NoneType"),
        (np.array(["a"]), "ndarray of <U1"),
        (np.array([1j]), "ndarray of complex128"),
        (np.array([None]), "ndarray of object"),
        (torch.tensor([1j]), "Tensor of torch.complex64"),
        (torch.eye(2).to_sparse(), "Tensor of torch.float32"),
    ],
)
def test_what_is_no_array_of_real_numbers_is_named(values, got):
    with pytest.raises(TypeError, match=f"light: expected a numpy array or torch tensor of real numbers, got {got}"):
        as_tensor("light", values)


@pytest.mark.parametrize(
    ("shape", "axes", "message"),
    [
        ((400, 600, 3), "3 height width", r"got \(400, 600, 3\); use transpose\(2, 0, 1\)$"),
        ((5, 8, 9, 4), "... 4 height width", r"got \(5, 8, 9, 4\); use transpose\(0, 3, 1, 2\)$"),
        ((400, 600), "3 height width", r"expected \(3, height, width\), got \(400, 600\)$"),
        ((3, 0, 4), "3 height width", r"got \(3, 0, 4\)$"),
        ((), "height width", r"got \(\)$"),
        ((7,), "... height width", r"expected \(\.\.\., height, width\), got \(7,\)$"),
    ],
)
def test_a_shape_that_does_not_fit_is_told_with_the_order_that_would(shape, axes, message):
    with pytest.raises(ValueError, match=message):
        check_shape("light", np.zeros(shape), axes)
    if "transpose" in message:
        with pytest.raises(ValueError, match=message.replace("transpose", "permute")):
            check_shape("light", torch.zeros(shape), axes)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.tensor([0, 200], dtype=torch.uint8), "got values up to 200; divide by 255"),
        (torch.tensor([0, 1], dtype=torch.uint8), "expected floating-point numbers, got torch.uint8; divide by 255"),
        (torch.tensor([0, 200], dtype=torch.uint16), "got values up to 200; divide by 65535"),
        (np.array([0, 4095]), "got values up to 4095; divide by 65535"),
        (np.array([0.0, 255.0]), "got values up to 255; divide by 255"),
        (np.array([0.0, 1e9]), "got values up to 1e\\+09; scale them"),
        (np.array([0.0, 1.02]), "got values up to 1.02; scale them"),
        (np.array([-0.5, 0.5]), "got values down to -0.5; scale them"),
        (np.array([True, False]), "expected floating-point numbers, got torch.bool"),
    ],
)
def test_values_out_of_range_are_told_what_to_divide_by(values, message):
    with pytest.raises(ValueError, match=message):
        fractions("light", values, "n")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_floats_of_any_precision_come_as_float32_or_float64(dtype):
    values = fractions("light", torch.tensor([0.25, 0.5], dtype=dtype), "n")
    assert values.tolist() == [0.25, 0.5]
    assert values.dtype in (torch.float32, torch.float64)
    assert not floats("light", torch.ones(2, requires_grad=True), "n").requires_grad


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.uint64])
def test_whole_numbers_of_any_type_are_int64(dtype):
    numbers = whole_numbers("t", np.array([1, 2], dtype))
    assert (numbers.dtype, numbers.tolist()) == (torch.int64, [1, 2])
    for values in (np.array([1.5]), np.array([True])):
        with pytest.raises(ValueError, match="t: expected whole numbers, got torch"):
            whole_numbers("t", values)


@pytest.mark.parametrize("values", [np.ones((2, 3)), np.ones((3, 2), bool)])
def test_a_mask_is_of_bool_and_of_the_frames_shape(values):
    with pytest.raises(ValueError, match=r"valid: expected a mask, bool of shape \(2, 3\), got torch"):
        mask_of("valid", values, (2, 3))
