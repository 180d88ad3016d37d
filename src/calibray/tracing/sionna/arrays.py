"""Arrays between NumPy and Dr.Jit."""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer


def points(position: NDArray[np.float64]) -> mi.Point3f:
    """Points for Sionna, whose values no kernel is compiled for.

    Args:
        position: Positions [n, 3], [m].

    Returns:
        The points.
    """
    points = mi.Point3f(*(aligned(axis, np.float32) for axis in position.T))
    dr.make_opaque(points)
    return points


def aligned(values: NDArray[Any], dtype: type) -> NDArray[Any]:
    """A copy that starts at a multiple of 64 bytes.

    Dr.Jit takes over NumPy's memory as it lies and compiles another kernel for another alignment. With an alignment
    left to chance its kernel cache is of little use, and every process compiles for seconds.

    Args:
        values: The numbers [n].
        dtype: Their type in the copy.

    Returns:
        The copy [n].
    """
    memory = np.empty(values.size * np.dtype(dtype).itemsize + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    copy = memory[start : start + memory.size - 64].view(dtype)
    copy[:] = values
    return copy


def gather(points: mi.Point3f, index: mi.UInt) -> mi.Point3f:
    """Some of the points.

    Args:
        points: The points.
        index: Which ones.

    Returns:
        Those, in that order.
    """
    return dr.gather(mi.Point3f, points, index)


def to_complex(value: mi.Complex2f) -> NDArray[np.complex128]:
    """Complex numbers in double precision.

    Args:
        value: The numbers.

    Returns:
        The same [n].
    """
    return np.array(value.real, dtype=float) + 1j * np.array(value.imag, dtype=float)


def per_interaction(buffer: PathsBuffer, name: str) -> NDArray[Any]:
    """A property of a buffer's interactions.

    Args:
        buffer: The buffer, with P paths of at most D interactions.
        name: The property's name.

    Returns:
        Whole numbers [P, D].
    """
    values = np.array(getattr(buffer, name), dtype=np.int64)
    return values.reshape(-1, buffer.depth_dim_size)


def vertices_of(buffer: PathsBuffer) -> NDArray[np.float64]:
    """A buffer's interaction points.

    Args:
        buffer: The buffer, with P paths of at most D interactions.

    Returns:
        Positions [P, D, 3], [m].
    """
    axes = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    return np.stack(
        [np.array(axis, dtype=float).reshape(-1, buffer.depth_dim_size) for axis in axes], axis=-1
    )
