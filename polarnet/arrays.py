"""Arrays of a caller's program, numpy or torch: checked once, where a public function takes them.

Behind that door everything is a torch tensor of known shape and range, so that kernels need no checks.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

Array = Tensor | np.ndarray

TOLERANCE = 1e-4  # float32 arithmetic may leave [0, 1] by some of its steps; more is a mistake of the caller's
WHITE = {torch.uint8: 2**8 - 1, torch.uint16: 2**16 - 1}
LARGEST_OVERSHOOT = 2.0  # floats up to here exceed white, as interpolation does; larger ones have another unit


def as_tensor(name: str, values: Any) -> Shaped[Tensor, "*shape"]:
    """A numpy array or torch tensor of real numbers as a tensor, which shares its memory where it can.

    TypeError for anything else: lists, text, pictures of other packages, complex numbers.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        too_wide = values.dtype.kind == "f" and values.dtype.itemsize > 8  # long double, which torch lacks
        native = np.asarray(values, np.float64 if too_wide else values.dtype.newbyteorder("="), order="C")
        # torch warns of arrays that are read-only, and refuses those that run backwards
        unfit = not native.flags.writeable or min(native.strides, default=0) < 0
        return torch.from_numpy(native.copy() if unfit else native)
    if isinstance(values, Tensor) and values.layout == torch.strided and not _exotic(values):
        return values
    kind = f" of {values.dtype}" if isinstance(values, Array) else ""
    raise TypeError(
        f"{name}: expected a numpy array or torch tensor of real numbers, got {type(values).__name__}{kind}"
    )


def whole_numbers(name: str, values: Any) -> Int64[Tensor, "*shape"]:
    """Integers of any type as int64 on the CPU. TypeError as `as_tensor`; ValueError for floats and truth values."""
    tensor = as_tensor(name, values)
    if tensor.is_floating_point() or tensor.dtype == torch.bool:
        raise ValueError(f"{name}: expected whole numbers, got {tensor.dtype}; round and convert them to int64")
    return tensor.cpu().to(torch.int64)


def mask_of(name: str, values: Any, shape: Sequence[int]) -> Bool[Tensor, "*shape"]:
    """Truth values of this shape. TypeError as `as_tensor`; ValueError for numbers or another shape."""
    tensor = as_tensor(name, values)
    if tensor.dtype != torch.bool or tuple(tensor.shape) != tuple(shape):
        raise ValueError(
            f"{name}: expected a mask, bool of shape {tuple(shape)}, got {tensor.dtype} of {tuple(tensor.shape)}"
        )
    return tensor


def check_shape(name: str, values: Array, axes: str) -> None:
    """ValueError unless `values` has these axes, such as "3 height width" or "... 4 height width", none of them empty.

    "..." stands for any leading axes, or none.
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
    """ValueError that names the arrays unless all have one shape: none is stretched to fit another."""
    shapes = {name: tuple(values.shape) for name, values in arrays.items()}
    if len(set(shapes.values())) > 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"expected {' and '.join(arrays)} of one shape, got {listed}")


def check_floating(name: str, values: Tensor) -> None:
    """ValueError for integers: their unit is not that of [0, 1], and their differences wrap round."""
    if not values.is_floating_point():
        raise ValueError(f"{name}: expected floating-point numbers, got {values.dtype}; {_scaling(values.dtype, 0)}")


def check_finite(name: str, values: Tensor) -> None:
    """ValueError that counts the values that are NaN or infinite, and says where the first is."""
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
    """ValueError where values leave [low, high] by more than `TOLERANCE`. `advice` None: how to scale a picture."""
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
    """Finite floating-point values as a tensor of float32 or float64 on the CPU, without a gradient.

    TypeError as `as_tensor`; ValueError for other axes (see `check_shape`), integers, NaN and infinity.
    """
    tensor = as_tensor(name, values).detach().cpu()
    check_shape(name, values, axes)
    check_floating(name, tensor)
    tensor = tensor if tensor.dtype == torch.float64 else tensor.float()
    check_finite(name, tensor)
    return tensor


def fractions(name: str, values: Any, axes: str, quantity: str = "values") -> Float[Tensor, "*shape"]:
    """Values in [0, 1], as `floats`; what float32 arithmetic leaves outside is clipped.

    ValueError also for values out of range, with the number to divide by. Integers are refused even where they would
    be in range: an array does not say which of them is white.
    """
    tensor = as_tensor(name, values).detach().cpu()
    check_shape(name, values, axes)
    if tensor.is_floating_point():
        tensor = floats(name, tensor, axes)
    check_range(name, tensor, 0, 1, quantity)
    check_floating(name, tensor)
    return tensor.clamp(0, 1)


def _exotic(values: Tensor) -> bool:
    return values.is_complex() or values.is_quantized or values.is_meta


def _fits(shape: tuple[int, ...], named: list[str]) -> bool:
    """Whether each axis has the length that its name says, or is not empty where the name is a word."""
    return len(shape) == len(named) and all(
        length == int(name) if name.isdigit() else length > 0 for length, name in zip(shape, named, strict=True)
    )


def _scaling(dtype: torch.dtype, highest: float | int) -> str:
    """How pictures of this type and with this highest value come to be in [0, 1]."""
    white = WHITE.get(dtype) or next((white for white in WHITE.values() if highest <= white), None)
    if white is None or (dtype not in WHITE and highest <= LARGEST_OVERSHOOT):
        return "scale them to [0, 1] as float32"
    return f"divide by {white}"
