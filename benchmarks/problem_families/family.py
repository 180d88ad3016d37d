"""Planted problems, drawn from seeds, for judging methods on problems that they were not tuned on.

A seed determines a district or an office, the carrier, 2 to 8 parameters with their planted values, and 20 to 200 links
measured with 1 to 4 dB of noise and perhaps offsets. It also determines an *engine* that acts as the expensive one, and
a *cheap model* of the same scene that lacks some features of the engine (`Differences`) and may have wrong thicknesses
and conductivities. Both evaluate traced paths, so a family is judged in minutes.

A family consists of all problems of one kind over a range of seeds. Seeds below 1020 are for development.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fitting.cheap_replay import DEEPER, further_layers
from calibray.materials import Material
from calibray.optimizers import LeastSquares
from calibray.optimizers.sampling import design
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind as InteractionKind
from calibray.paths import Paths, concatenate, take, take_links
from calibray.scenes import read_scene
from calibray.support.messages import did_you_mean
from calibray.tracing import SIONNA, cache
from calibray.tracing.settings import Antenna, TraceSettings
from problem_families import optima
from problem_families.numpy_replay import NumpyReplay
from problem_families.sites import MaterialRange, Site, district_site, office_site

FamilyKind = Literal["district", "office"]

CARRIERS: Final = (0.9e9, 2.1e9, 3.5e9, 4e9, 5.9e9, 10e9)  # [Hz]
PARAMETERS: Final = (2, 8)  # fewest and most
LINKS: Final = (20, 200)
NOISE_DB: Final = (1.0, 4.0)
OFFSET_DB: Final = 3.0  # standard deviation of a transmitter's offset
UPPER_PERMITTIVITY: Final = (9.0, 15.0)
CONDUCTIVITIES: Final = (1e-3, 1.0)  # [S/m], bounds of the search
HALF_SPACE: Final = 100.0
"""Thickness at which a slab is so lossy that no wave returns from its far side [m]."""

DRAWN: Final = 2.5
"""Links drawn for each one kept, because some have no path."""

ONE_SIDED: Final = 8
"""Of the links with a path only in the engine, one in this number is kept."""

SAMPLES: Final = 100_000
DIFFUSE_SAMPLES: Final = 1_000
WEAK: Final = 0.003
"""Share of a link's power below which a path is left out, for speed."""

PROBES: Final = 8
STARTS: Final = 64
"""Local searches for the global optimum."""


class Answer(NamedTuple):
    """The evaluation of points of the search space."""

    value: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None


@dataclass(frozen=True)
class Differences:
    """Differences of the engine from the cheap model.

    Attributes:
        depth: Largest number of interactions of a path, of the engine and of the cheap model.
        diffraction: Whether the engine diffracts.
        diffuse_reflection: Whether its surfaces scatter.
        half_space: Whether its walls are half-spaces (Fresnel coefficients) while those of the cheap model are slabs.
        antennas: Whether its antennas are dipoles while those of the cheap model are isotropic.
        position_error: Standard deviation between their positions, in x and y [m].
        wrong_constants: Whether the cheap model has wrong thicknesses and conductivities.
    """

    depth: tuple[int, int]
    diffraction: bool
    diffuse_reflection: bool
    half_space: bool
    antennas: bool
    position_error: float
    wrong_constants: bool


@dataclass(frozen=True, eq=False)
class PlantedProblem:
    """One problem of a family; the search space is that of `parameters`.

    Attributes:
        kind: "district" or "office".
        seed: Seed of the problem.
        frequency: Carrier frequency [Hz].
        parameters: The calibrated parameters with their bounds [d], which define the search space.
        engine: The expensive engine.
        cheap: The cheap model: the same parameters on the paths of a simpler trace, +inf for a link without a path.
        differences: Differences of the engine from the cheap model.
        measured: Measured path loss [L], [dB].
        station: Transmitter of each link [L].
        offsets: Whether every transmitter's measurements have an unknown offset.
        noise_db: Standard deviation of the noise [dB].
        truth: The planted candidate [d], in the fields' units.
        further: Layers of paths that the simpler trace leaves out, by which the cheap model is extended.
    """

    kind: FamilyKind
    seed: int
    frequency: float
    parameters: Parameters
    engine: NumpyReplay
    cheap: NumpyReplay
    differences: Differences
    measured: NDArray[np.float64]
    station: NDArray[np.int64]
    offsets: bool
    noise_db: float
    truth: NDArray[np.float64]
    further: tuple[Paths, ...] = ()

    @property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds of the search space [d]."""
        return self.parameters.search_bounds[0]

    @property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds of the search space [d]."""
        return self.parameters.search_bounds[1]

    def residuals(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals of a path loss [n, L], with each transmitter's best offset eliminated if there are offsets [dB]."""
        return self._without_offsets(path_loss - self.measured)

    def evaluate(self, points: NDArray[np.float64], derivatives: bool = False) -> Answer:
        """Evaluate the engine.

        Args:
            points: Points of the search space [n, d].
            derivatives: Whether the Jacobian is wanted.

        Returns:
            RMSE [n], [dB], residuals [n, L] and, if wanted, their derivatives by the search coordinates [n, L, d].
        """
        candidates = self.parameters.from_search(points)
        jacobian = None
        if derivatives:
            loss, slope = self.engine.path_loss_and_jacobian(candidates)
            slope = slope * self.parameters.search_slope(candidates)[:, None, :]
            jacobian = np.moveaxis(self._without_offsets(np.moveaxis(slope, 1, -1)), -1, 1)
        else:
            loss = self.engine.path_loss(candidates)
        residuals = self.residuals(loss)
        return Answer(np.sqrt(np.mean(residuals**2, axis=1)), residuals, jacobian)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of all data on which an evaluation depends, in hexadecimal."""
        digest = hashlib.sha256(json.dumps([self.kind, self.offsets, self.parameters.names]).encode())
        middle = self.evaluate(0.5 * (self.lower + self.upper)[None]).residuals
        # Derived numbers may differ by rounding errors between machines.
        for part in (self.lower, self.upper, self.measured, self.station, middle):
            digest.update(np.round(part, 6).astype("<f8").tobytes())
        return digest.hexdigest()

    @property
    def minimum_rmse_db(self) -> float:
        """The lowest RMSE within the bounds [dB], found by least squares from `STARTS` points and stored on disk."""
        kept = optima.find(self.fingerprint, STARTS)
        if kept is not None:
            return kept
        search = LeastSquares(self.lower, self.upper, starts=STARTS, x0=self.parameters.to_search(self.truth))
        while not search.done:
            points = search.ask()
            answer = self.evaluate(points, derivatives=True)
            search.tell(points, answer.value, residuals=answer.residuals, jacobian=answer.jacobian)
        optima.keep(self.fingerprint, STARTS, search.best.y)
        return search.best.y

    def _without_offsets(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values over the links [..., L], minus each transmitter's mean if there are offsets."""
        if not self.offsets:
            return rows
        share = (self.station == np.arange(self.station.max() + 1)[:, None]).astype(np.float64)
        means = rows @ (share / share.sum(axis=1, keepdims=True)).T
        return rows - means[..., self.station]


def problem(seed: int, kind: str = "district") -> PlantedProblem:
    """Draw a problem.

    The first call traces, which takes tens of seconds; traces are cached (`calibray.tracing.cache`).

    Args:
        seed: Seed of the problem; 1020 and above are for judging.
        kind: "district" or "office".

    Returns:
        The problem.

    Raises:
        InputError: There is no such kind, the seed is negative, or no tracer is available.
    """
    if kind not in get_args(FamilyKind):
        raise InputError(
            f"family {kind!r}: there is no such family; {did_you_mean(kind, get_args(FamilyKind))}"
        )
    if seed < 0:
        raise InputError(f"seed = {seed}; it must be 0 or greater")
    rng = np.random.Generator(np.random.PCG64([seed, get_args(FamilyKind).index(kind)]))
    count = round(float(np.exp(rng.uniform(*np.log(LINKS)))))
    site = (office_site if kind == "office" else district_site)(rng, int(np.ceil(DRAWN * count)))
    frequency = float(rng.choice(CARRIERS))
    differences = _differences(site, rng)
    truth = {name: _material(ranges, frequency, differences, rng) for name, ranges in site.materials.items()}
    engine_paths, cheap_paths, deeper_paths = _trace(site, truth, frequency, differences, rng)
    kept = _kept(engine_paths, cheap_paths)[:count]
    parameters = _parameters(truth, frequency, rng)
    planted = np.array([getattr(truth[item.material], item.field) for item in parameters])
    engine = _without_weak_paths(take_links(engine_paths, kept), parameters)
    station = np.unique(site.tx[kept], axis=0, return_inverse=True)[1].reshape(-1)
    noise, offsets = float(rng.uniform(*NOISE_DB)), bool(rng.random() < 0.5)
    error = noise * rng.standard_normal(len(kept))
    error += offsets * OFFSET_DB * rng.standard_normal(station.max() + 1)[station]
    return PlantedProblem(
        "office" if kind == "office" else "district",
        seed,
        frequency,
        parameters,
        engine,
        _without_weak_paths(take_links(cheap_paths, kept), parameters),
        differences,
        engine.path_loss(planted[None])[0] + error,
        station,
        offsets,
        noise,
        planted,
        further_layers(take_links(deeper_paths, kept), differences.depth[1], False),
    )


def _kept(engine_paths: Paths, cheap_paths: Paths) -> NDArray[np.int64]:
    """Links with a path in the engine, most of which also have a path in the cheap model."""
    engine, cheap = (
        np.bincount(paths.link, minlength=paths.num_links) > 0 for paths in (engine_paths, cheap_paths)
    )
    return np.flatnonzero(engine & (cheap | (np.arange(len(engine)) % ONE_SIDED == 0)))


def _without_weak_paths(paths: Paths, parameters: Parameters) -> NumpyReplay:
    """The program without paths that carry less than `WEAK` of their link's power at each of several candidates."""
    whole = NumpyReplay(paths, parameters)
    unit = design("sobol", PROBES, len(parameters), np.random.default_rng(0))
    power = whole.path_powers(parameters.from_unit(unit))
    link = np.zeros((len(power), paths.num_links))
    np.add.at(link.T, paths.link, power.T)
    strong = (power >= WEAK * link[:, paths.link]).any(axis=0)
    return NumpyReplay(take(paths, np.flatnonzero(strong)), parameters)


def _differences(site: Site, rng: np.random.Generator) -> Differences:
    draw = rng.random(7)
    deep = bool(draw[0] < 0.7) or bool((draw[1:6] >= 0.4).all())
    most = int(rng.integers(3, 5))
    return Differences(
        depth=(most, 2 if deep else most),
        diffraction=bool(draw[1] < 0.5),
        diffuse_reflection=bool(draw[2] < 0.4),
        half_space=bool(draw[3] < 0.3) and not site.indoors,
        antennas=bool(draw[4] < 0.4),
        position_error=float(rng.uniform(0.2, 1.0)) * (0.2 if site.indoors else 1.0) * bool(draw[5] < 0.4),
        wrong_constants=bool(draw[6] < 0.5),
    )


def _material(
    ranges: MaterialRange, frequency: float, differences: Differences, rng: np.random.Generator
) -> Material:
    """The true constants of a material, which the engine uses."""
    conductivity = float(np.exp(rng.uniform(*np.log(ranges.conductivity)))) * frequency / 4e9
    thickness, scattering = rng.uniform(*ranges.thickness), rng.uniform(*ranges.scattering_coefficient)
    return Material(
        float(rng.uniform(*ranges.relative_permittivity)),
        conductivity,
        HALF_SPACE if differences.half_space else float(thickness),
        float(scattering) if differences.diffuse_reflection else 0.0,
    )


def _believed(
    site: Site, truth: Mapping[str, Material], differences: Differences, rng: np.random.Generator
) -> dict[str, Material]:
    """The materials of the cheap model: slabs that do not scatter."""
    believed = {}
    for name, material in truth.items():
        thickness = material.thickness
        if differences.half_space:
            thickness = float(rng.uniform(*site.materials[name].thickness))
        factor, decades = rng.uniform(0.3, 1.7), rng.uniform(-0.5, 0.5)
        conductivity = material.conductivity
        if differences.wrong_constants:
            thickness, conductivity = thickness * float(factor), conductivity * float(10.0**decades)
        believed[name] = Material(material.relative_permittivity, conductivity, thickness)
    return believed


def _trace(
    site: Site,
    truth: Mapping[str, Material],
    frequency: float,
    differences: Differences,
    rng: np.random.Generator,
) -> tuple[Paths, Paths, Paths]:
    """The paths of the engine, of the cheap model, and of a trace with which the cheap model is extended."""
    believed = _believed(site, truth, differences, rng)
    moved = _Links(*(_displaced(ends, differences.position_error, rng) for ends in (site.tx, site.rx)))
    dipole, simple = Antenna("dipole", "V"), Antenna("iso" if differences.antennas else "dipole", "V")
    base = TraceSettings(
        max_depth=differences.depth[0],
        refraction=site.indoors,
        diffraction=differences.diffraction,
        samples=SAMPLES,
    )
    cheap = replace(base, max_depth=differences.depth[1], diffraction=False)
    with TemporaryDirectory() as folder:
        scene = site.write(Path(folder))
        engine_paths = _paths(scene, truth, moved, frequency, base, dipole)
        if differences.diffuse_reflection:
            scattering = replace(
                base, max_depth=2, diffraction=False, diffuse_reflection=True, samples=DIFFUSE_SAMPLES
            )
            mixed = _paths(scene, truth, moved, frequency, scattering, dipole)
            path = np.repeat(np.arange(mixed.num_paths), np.diff(mixed.first))
            diffuse = np.unique(path[mixed.kind == InteractionKind.DIFFUSE])
            engine_paths = concatenate([engine_paths, take(mixed, diffuse)])
        richer = replace(cheap, max_depth=cheap.max_depth + DEEPER, diffraction=True)
        cheap_paths, deeper_paths = (
            _paths(scene, believed, _Links(site.tx, site.rx), frequency, settings, simple)
            for settings in (cheap, richer)
        )
        return engine_paths, cheap_paths, deeper_paths


@dataclass(frozen=True)
class _Links:
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]


def _displaced(ends: NDArray[np.float64], error: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Ends of links [n, 3], [m], displaced horizontally; equal ends stay equal."""
    positions, owner = np.unique(ends, axis=0, return_inverse=True)
    step = np.clip(rng.standard_normal((len(positions), 2)), -2.0, 2.0)
    return ends + error * np.pad(step, [(0, 0), (0, 1)])[owner.reshape(-1)]


def _paths(
    file: Path,
    materials: Mapping[str, Material],
    links: _Links,
    frequency: float,
    settings: TraceSettings,
    antenna: Antenna,
) -> Paths:
    """The paths of links, from the cache if they were traced before."""
    scene = read_scene(file, frequency, materials)
    digest = cache.trace_digest(SIONNA.versions, scene, frequency, settings, (antenna, antenna), links)
    paths = cache.load_trace(digest)
    if paths is None:
        paths = SIONNA(scene, frequency, settings, antenna, antenna).trace(links)
        cache.store_trace(digest, paths)
    return paths


def _parameters(truth: Mapping[str, Material], frequency: float, rng: np.random.Generator) -> Parameters:
    """The calibrated parameters: permittivities first, then conductivities."""
    wanted = int(rng.integers(PARAMETERS[0], PARAMETERS[1] + 1))
    names = rng.permutation(sorted(truth)).tolist()
    permittivities = min(len(names), max(2, int(np.ceil(0.65 * wanted))))
    chosen = [_permittivity(name, rng) for name in names[:permittivities]]
    chosen += [_conductivity(name, frequency) for name in names[: wanted - permittivities]]
    return Parameters(tuple(chosen), frequency)


def _permittivity(name: str, rng: np.random.Generator) -> Parameter:
    upper = float(np.round(rng.uniform(*UPPER_PERMITTIVITY), 1))
    return Parameter(f"{name}.relative_permittivity", 1.5, upper, 5.0)


def _conductivity(name: str, frequency: float) -> Parameter:
    low, high = (bound * frequency / 4e9 for bound in CONDUCTIVITIES)
    return Parameter(f"{name}.conductivity", low, high, float(np.sqrt(low * high)), "log")
