"""Engines: what turns candidates into path loss.

- `Replay` evaluates stored paths: microseconds a candidate, with derivatives.
- `Retrace` runs the ray tracer anew for every candidate: the cost model of the paper, and replay's rival.

A run of one candidate over all links is an RT call. It is counted here, where the engine runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from calibray import cache, fields, tabulation
from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.paths import Paths
from calibray.scene import Scene, read_scene
from calibray.study import Study
from calibray.tracing import Tracer

ENGINES: Final = ("replay", "retrace")
BLOCK_INTERACTIONS: Final = 2_000_000  # interactions x candidates evaluated at once, which bounds the memory
TABULATED: Final = 50_000  # interactions beyond which coefficients come from tables
FIRST_INTERVALS: Final = 2048  # of a table over the cosine of incidence
LAST_INTERVALS: Final = 65536
TABLE_TOLERANCE: Final = 1e-4  # largest error of a tabulated coefficient
BLOCK_SIZES: Final = (1, 8, 32)  # candidates a call; every size is compiled once

Progress = Callable[[int, int], None]


@runtime_checkable
class Engine(Protocol):
    """What a calibration runs on."""

    @property
    def calls(self) -> int:
        """RT calls so far: candidates that the engine has run over all links."""
        ...

    @property
    def parameters(self) -> Parameters:
        """The parameters that a candidate's components stand for."""
        ...

    @property
    def materials(self) -> dict[str, Material]:
        """The scene's materials before calibration."""
        ...

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss of every link for candidates [n, d] in the fields' units; [n, L], [dB], +inf without a path."""
        ...


class Replay:
    """Stored paths, evaluated for any candidate.

    Args:
        paths: The path program.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        dtype: Precision, `numpy.float64` or `numpy.float32`.

    Raises:
        InputError: A parameter's material is not in the paths, or the combining cannot be used.
    """

    def __init__(
        self,
        paths: Paths,
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        dtype: type = np.float64,
    ) -> None:
        self.paths, self.parameters, self.materials, self.calls = paths, parameters, dict(paths.materials), 0
        self._dtype = dtype
        self._offsets = fields.check_combining(paths, combining, bandwidth)
        self._combining = combining
        self._rows, columns = parameters.indices(list(paths.materials))
        used, self._places = np.unique(columns, return_inverse=True)
        self._columns = columns
        self._base = jnp.asarray(fields.constants(paths).astype(dtype))
        self._fields = tuple(int(column) for column in used)
        self._intervals = FIRST_INTERVALS if paths.num_interactions > TABULATED else None
        self._program = fields.layout(paths, dtype, self._intervals).program
        room = max(1, BLOCK_INTERACTIONS // max(paths.num_interactions, 1))
        self._sizes = [size for size in BLOCK_SIZES if size <= room]

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        (loss,) = self._run(self._value, candidates)
        return loss

    def path_loss_and_jacobian(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Path loss of every link, and its derivatives by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        loss, jacobian = self._run(self._jacobian, candidates)
        return loss, jacobian

    def _value(self, tables: jax.Array) -> tuple[jax.Array]:
        local = _local_values(self._program, tables)
        power = _power(self._program, local, self._combining, self._offsets)
        return (fields.decibel(power),)

    def _jacobian(self, tables: jax.Array) -> tuple[jax.Array, jax.Array]:
        local, tangents = _local_tangents(self._program, tables, self._fields)
        power, slope = _power_and_slope(self._program, local, self._combining, self._offsets)
        derivative = _decibel_slope(self._program, power, slope, tangents, tables.shape[1])
        return fields.decibel(power), derivative[:, :, self._rows, self._places]

    def _run(self, function: Callable, candidates: np.ndarray) -> tuple[np.ndarray, ...]:
        values = check_candidates(candidates, len(self.parameters)).astype(self._dtype)
        parts, start = [], 0
        while start < len(values):
            left = len(values) - start
            size = next((size for size in self._sizes if size >= left), self._sizes[-1])
            block = values[start : start + size]
            padded = np.concatenate([block, np.repeat(block[-1:], size - len(block), axis=0)])
            tables = _tables(self._base, self._rows, self._columns, jnp.asarray(padded))
            self._refine(tables)
            parts.append([np.asarray(part)[: len(block)] for part in function(tables)])
            start += len(block)
        self.calls += len(values)
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

    def _refine(self, tables: jax.Array) -> None:
        """Make the tables of coefficients fine enough for these candidates, and for all that follow."""
        while self._intervals is not None and (
            float(_table_error(self._program.lookup, tables, self._program.wavelength).max())
            > TABLE_TOLERANCE
        ):
            self._intervals = 2 * self._intervals if self._intervals < LAST_INTERVALS else None
            self._program = fields.layout(self.paths, self._dtype, self._intervals).program


# Stages compiled apart, each over a batch of candidates; see `calibray.fields`.
_tables = jax.jit(
    lambda base, rows, columns, values: jax.vmap(lambda value: base.at[rows, columns].set(value))(values)
)
_local_values = jax.jit(jax.vmap(fields.local_values, in_axes=(None, 0)))
_table_error = jax.jit(jax.vmap(tabulation.table_error, in_axes=(None, 0, None)))


@partial(jax.jit, static_argnames="columns")
def _local_tangents(program: fields.Program, tables: jax.Array, columns: tuple[int, ...]) -> tuple:
    return jax.vmap(lambda table: fields.local_tangents(program, table, columns))(tables)


@partial(jax.jit, static_argnames="combining")
def _power(
    program: fields.Program, local: fields.Local, combining: str, offsets: jax.Array | None
) -> jax.Array:
    return jax.vmap(lambda one: fields.program_power(program, one, combining, offsets))(local)


@partial(jax.jit, static_argnames="combining")
def _power_and_slope(
    program: fields.Program, local: fields.Local, combining: str, offsets: jax.Array | None
) -> tuple[jax.Array, fields.Local]:
    return jax.vmap(lambda one: fields.power_and_slope(program, one, combining, offsets))(local)


@partial(jax.jit, static_argnames="materials")
def _decibel_slope(
    program: fields.Program, power: jax.Array, slope: fields.Local, tangents: tuple, materials: int
) -> jax.Array:
    one = partial(fields.decibel_slope, program, num_materials=materials)
    return jax.vmap(lambda power, slope, tangents: one(power, slope, tangents))(power, slope, tangents)


class Retrace:
    """The ray tracer, run anew for every candidate.

    Args:
        tracer: The scene in the ray tracer.
        links: The links.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        progress: Called with (candidates run, candidates asked for) after every one.
    """

    def __init__(
        self,
        tracer: Tracer,
        links: Measurements,
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(tracer.scene.materials), 0
        self._tracer, self._links, self._progress = tracer, links, progress
        self._combining, self._bandwidth = combining, bandwidth

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss of every link for candidates, each with a trace of its own.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is outside physics.
        """
        values = check_candidates(candidates, len(self.parameters))
        losses = []
        for done, candidate in enumerate(values):
            losses.append(self._one(self.parameters.materials(candidate, self.materials)))
            self.calls += 1
            if self._progress is not None:
                self._progress(done + 1, len(values))
        return np.array(losses).reshape(len(values), len(self._links))

    def _one(self, materials: dict[str, Material]) -> np.ndarray:
        self._tracer.set_materials(materials)
        trace = self._tracer.trace(self._links)
        gain, link, delay = trace.path_gains(), trace.link(), trace.delay()
        offsets = fields.band_quadrature(link, delay, self._bandwidth) if self._combining == "band" else None
        parts = tuple(jnp.asarray(np.moveaxis(part, 0, -1)) for part in (gain.real, gain.imag))
        power = fields.link_power(
            parts, link, delay, len(self._links), self._tracer.frequency, self._combining, offsets
        )
        return np.asarray(fields.decibel(power))


def make(study: Study, name: str | None = None, progress: Progress | None = None) -> Replay | Retrace:
    """The engine of a study.

    Args:
        study: The study.
        name: "replay" or "retrace"; the study's own if None.
        progress: Called with (done, in all) after every chunk of receivers traced, or every candidate re-traced.

    Returns:
        The engine, over all links of the study, those held out included.

    Raises:
        InputError: The engine is unknown, or the study's scene, links or parameters cannot be used.
    """
    name = name or study.engine.name
    if name not in ENGINES:
        raise InputError(f"engine {name!r}: must be one of {', '.join(ENGINES)}")
    links = study.measurements()
    scene = make_scene(study)
    parameters = study.parameter_set(scene.materials)
    options = study.objective.combining, study.scene.bandwidth
    if name == "retrace":
        return Retrace(_tracer(study, scene), links, parameters, *options, progress)
    return Replay(traced_paths(study, scene, links, progress), parameters, *options)


def traced_paths(study: Study, scene: Scene, links: Measurements, progress: Progress | None = None) -> Paths:
    """The paths of some links in a study's scene, from the cache if they were traced before.

    Args:
        study: The study.
        scene: Its scene, with the materials to trace with.
        links: The links.
        progress: Called with (receivers traced, receivers in all) after every chunk.

    Returns:
        The path program.
    """
    antennas = study.antennas.tx, study.antennas.rx
    digest = cache.trace_digest(scene, study.scene.frequency, study.trace, antennas, links.tx, links.rx)
    paths = cache.find(digest)
    if paths is None:
        paths = _tracer(study, scene).trace(links, progress).paths()
        cache.keep(digest, paths)
    return paths


def make_scene(study: Study, materials: dict[str, Material] | None = None) -> Scene:
    """A study's scene.

    Args:
        study: The study.
        materials: Constants in place of the scene's, by name; None for the scene's with the parameters' starts.

    Returns:
        The scene, with the materials to trace with.

    Raises:
        InputError: The scene or the parameters cannot be used.
    """
    overrides = {**study.overrides, **(materials or {})}
    scene = read_scene(study.scene_source, study.scene.frequency, overrides, study.objects)
    if materials is None:  # what is sampled while tracing, as diffuse reflection is, follows the materials
        parameters = study.parameter_set(scene.materials)
        scene = replace(scene, materials=parameters.materials(parameters.start, scene.materials))
    return scene


def make_tracer(study: Study, materials: dict[str, Material] | None = None) -> Tracer:
    """The ray tracer loaded with a study's scene.

    Args:
        study: The study.
        materials: Constants in place of the scene's, by name; None for the scene's with the parameters' starts.

    Returns:
        The tracer.

    Raises:
        InputError: The scene or the parameters cannot be used.
    """
    return _tracer(study, make_scene(study, materials))


def _tracer(study: Study, scene: Scene) -> Tracer:
    return Tracer(scene, study.scene.frequency, study.trace, study.antennas.tx, study.antennas.rx)


def check_candidates(candidates: np.ndarray, width: int) -> np.ndarray:
    """Candidates as an array, refused if they cannot be evaluated.

    Args:
        candidates: Parameter values [n, d].
        width: Number of parameters d.

    Returns:
        The values [n, d].

    Raises:
        InputError: The shape is another, or a value is not finite.
    """
    values = np.asarray(candidates, dtype=float)
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise InputError(f"candidates: shape {values.shape}, must be (n, {width}) with n at least 1")
    if not np.isfinite(values).all():
        raise InputError("candidates: hold a value that is not finite; give numbers within the bounds")
    return values
