"""Checks of a caller's arrays, numpy or torch, at the entry of public functions.

Inside the package all arrays are torch tensors of known shape and range, so kernels need no checks.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

Array = Tensor | np.ndarray

TOLERANCE = 1e-4  # float32 rounding may exceed [0, 1] slightly; a larger excess is the caller's error
WHITE = {torch.uint8: 2**8 - 1, torch.uint16: 2**16 - 1}
MAX_OVERSHOOT = 2.0  # floats up to this are overshoot, as from interpolation; larger ones have another unit


def as_tensor(name: str, values: Any) -> Shaped[Tensor, "*shape"]:
    """Convert a numpy array or torch tensor of real numbers to a tensor that shares its memory if possible.

    Raises TypeError for anything else, such as lists, text, image objects of other packages and complex numbers.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        too_wide = values.dtype.kind == "f" and values.dtype.itemsize > 8  # long double, which torch lacks
        native = np.asarray(values, np.float64 if too_wide else values.dtype.newbyteorder("="), order="C")
        # torch warns about read-only arrays and refuses negative strides
        unfit = not native.flags.writeable or min(native.strides, default=0) < 0
        return torch.from_numpy(native.copy() if unfit else native)
    exotic = isinstance(values, Tensor) and (values.is_complex() or values.is_quantized or values.is_meta)
    if isinstance(values, Tensor) and values.layout == torch.strided and not exotic:
        return values
    kind = f" of {values.dtype}" if isinstance(values, Array) else ""
    raise TypeError(
        f"{name}: expected a numpy array or torch tensor of real numbers, got {type(values).__name__}{kind}"
    )


def whole_numbers(name: str, values: Any) -> Int64[Tensor, "*shape"]:
    """Convert integers of any type to int64 on the CPU.

    Raises TypeError as `as_tensor`, and ValueError for floats and booleans.
    """
    tensor = as_tensor(name, values)
    if tensor.is_floating_point() or tensor.dtype == torch.bool:
        raise ValueError(f"{name}: expected whole numbers, got {tensor.dtype}; round and convert them to int64")
    return tensor.cpu().to(torch.int64)


def mask_of(name: str, values: Any, shape: Sequence[int]) -> Bool[Tensor, "*shape"]:
    """Convert a boolean array of the given shape to a tensor.

    Raises TypeError as `as_tensor`, and ValueError for numbers or another shape.
    """
    tensor = as_tensor(name, values)
    if tensor.dtype != torch.bool or tuple(tensor.shape) != tuple(shape):
        raise ValueError(
            f"{name}: expected a mask, bool of shape {tuple(shape)}, got {tensor.dtype} of {tuple(tensor.shape)}"
        )
    return tensor


def check_shape(name: str, values: Array, axes: str) -> None:
    """Raise ValueError unless `values` has the given axes, such as "3 height width", and none of them is empty.

    "..." stands for any number of leading axes, as in "... 4 height width".
    """
    shape, wanted = tuple(values.shape), axes.split()
    named = [axis for axis in wanted if axis != "..."]
    leading = len(shape) - len(named) if "..." in wanted else 0
    own = shape[max(leading, 0) :]
    if _fits(own, named):
        return
    advice = ""
    if own and _fits((own[-1], *own[:-1]), named):
        verb = "permute" if isinstance(values, Tensor) else "transpose"
        order = (*range(leading), len(shape) - 1, *range(leading, len(shape) - 1))
        advice = f"; use {verb}({', '.join(map(str, order))})"
    raise ValueError(f"{name}: expected ({', '.join(wanted)}), got {shape}{advice}")


def check_same_shape(arrays: Mapping[str, Tensor]) -> None:
    """Raise ValueError with the names of the arrays unless all have the same shape; there is no broadcasting."""
    shapes = {name: tuple(values.shape) for name, values in arrays.items()}
    if len(set(shapes.values())) > 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"expected {' and '.join(arrays)} of one shape, got {listed}")


def check_floating(name: str, values: Tensor) -> None:
    """Raise ValueError for integers, which are not scaled to [0, 1] and whose differences wrap around."""
    if not values.is_floating_point():
        raise ValueError(f"{name}: expected floating-point numbers, got {values.dtype}; {_scaling(values.dtype, 0)}")


def check_finite(name: str, values: Tensor) -> None:
    """Raise ValueError with the count of NaN and infinite values and the position of the first."""
    wrong = values.isfinite().logical_not()
    if wrong.any():
        first = tuple(wrong.nonzero()[0].tolist())
        raise ValueError(
            f"{name}: expected finite numbers, got {int(wrong.sum())} of {values.numel()} that are NaN or infinite, "
            f"the first at {first}; replace them"
        )


def check_range(
    name: str, values: Tensor, low: float | int, high: float | int, quantity: str = "values", advice: str | None = None
) -> None:
    """Raise ValueError if values exceed [low, high] by more than `TOLERANCE`.

    The message ends with `advice`; None gives advice on scaling an image.
    """
    if not values.numel():
        return
    compared = values.detach() if values.is_floating_point() else values.double()  # torch compares few integer types
    lowest, highest = (float(bound) for bound in compared.aminmax())
    if highest > high + TOLERANCE or lowest < low - TOLERANCE:
        got = f"up to {highest:g}" if highest > high + TOLERANCE else f"down to {lowest:g}"
        raise ValueError(
            f"{name}: expected {quantity} in [{low:.6g}, {high:.6g}], got values {got}; "
            f"{advice or _scaling(values.dtype, highest)}"
        )


def floats(name: str, values: Any, axes: str) -> Float[Tensor, "*shape"]:
    """Convert finite floating-point values to float32 or float64 on the CPU, without gradient.

    Raises TypeError as `as_tensor`, and ValueError for other axes (see `check_shape`), integers, NaN and infinity.
    """
    tensor = as_tensor(name, values).detach().cpu()
    check_shape(name, values, axes)
    check_floating(name, tensor)
    tensor = tensor if tensor.dtype == torch.float64 else tensor.float()
    check_finite(name, tensor)
    return tensor


def fractions(name: str, values: Any, axes: str, quantity: str = "values") -> Float[Tensor, "*shape"]:
    """Convert values in [0, 1] as `floats` does, clipping float32 rounding errors; the ValueError names a divisor.

    Integers are refused even within the range, because an array does not say which integer is white.
    """
    tensor = as_tensor(name, values).detach().cpu()
    check_shape(name, values, axes)
    if tensor.is_floating_point():
        tensor = floats(name, tensor, axes)
    check_range(name, tensor, 0, 1, quantity)
    check_floating(name, tensor)
    return tensor.clamp(0, 1)


def _fits(shape: tuple[int, ...], named: list[str]) -> bool:
    """Whether each axis has the length in `named`, or is non-empty if `named` gives a word."""
    return len(shape) == len(named) and all(
        length == int(name) if name.isdigit() else length > 0 for length, name in zip(shape, named, strict=True)
    )


def _scaling(dtype: torch.dtype, highest: float | int) -> str:
    """Advice on scaling an image of this type and maximum to [0, 1]."""
    white = WHITE.get(dtype) or next((white for white in WHITE.values() if highest <= white), None)
    if white is None or (dtype not in WHITE and highest <= MAX_OVERSHOOT):
        return "scale them to [0, 1] as float32"
    return f"divide by {white}"
