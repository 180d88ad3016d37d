"""Arrays between NumPy and Dr.Jit."""

# Mitsuba defines its types when its variant is chosen, so its stubs declare them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer


def aligned(values: NDArray[Any], dtype: type) -> NDArray[Any]:
    """Copy numbers [n] to memory that starts at a multiple of 64 bytes, converted to a type.

    Dr.Jit takes over NumPy's memory without copying it and compiles a separate kernel for each alignment. With random
    alignment its kernel cache rarely hits, and every process compiles for seconds.
    """
    memory = np.empty(values.size * np.dtype(dtype).itemsize + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    copy = memory[start : start + memory.size - 64].view(dtype)
    copy[:] = values
    return copy


def to_points(position: NDArray[np.float64]) -> mi.Point3f:
    """Convert positions [n, 3], [m], to points; opaque, so that no kernel is compiled for their values."""
    points = mi.Point3f(*(aligned(axis, np.float32) for axis in position.T))
    dr.make_opaque(points)
    return points


def to_numpy_complex(value: mi.Complex2f) -> NDArray[np.complex128]:
    """Convert complex numbers to double precision [n]."""
    return np.array(value.real, dtype=float) + 1j * np.array(value.imag, dtype=float)


def per_interaction(buffer: PathsBuffer, name: str) -> NDArray[np.int64]:
    """Read an integer property of the interactions of a buffer's paths [P, D]."""
    return np.array(getattr(buffer, name), dtype=np.int64).reshape(-1, buffer.depth_dim_size)


def vertices_of(buffer: PathsBuffer) -> NDArray[np.float64]:
    """Read the interaction points of a buffer's paths [P, D, 3], [m]."""
    axes = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    return np.stack(
        [np.array(axis, dtype=float).reshape(-1, buffer.depth_dim_size) for axis in axes], axis=-1
    )


def normals_at(buffer: PathsBuffer, step: int, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Read the normals of the surfaces that paths meet at interaction `step` [P, 3]; undefined outside the mask [P]."""
    normals = buffer.get_primitive_props(mi.UInt(step + 1), True, False, mi.Bool(aligned(mask, np.bool_)))
    return np.array(normals, dtype=float).T.reshape(-1, 3)
