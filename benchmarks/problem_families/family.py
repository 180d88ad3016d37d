"""A family of planted problems: for judging methods where nobody tuned them.

A problem is drawn from its seed: a district or an office, the carrier, 2 to 8 parameters with their planted values, 20
to 200 links measured with 1 to 4 dB of noise and perhaps offsets; an *engine* that answers like an expensive one, and
beside it a *cheap* model of the same scene that lacks some of what the engine has (`Differences`), and may be told
wrong thicknesses and conductivities. Both evaluate traced paths, so a family is judged in minutes.

A family is all problems of a kind over a range of seeds. Seeds below 1000 are for development.
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
from calibray.materials import Material
from calibray.optimizers import LeastSquares
from calibray.optimizers.sampling import design
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind as InteractionKind
from calibray.paths import Paths, concatenate, take, take_links
from calibray.scenes import read_scene
from calibray.support.messages import did_you_mean
from calibray.tracing import cache
from calibray.tracing.default_tracer import SIONNA
from calibray.tracing.settings import Antenna, TraceSettings
from problem_families import optima
from problem_families.numpy_replay import Direct
from problem_families.office import office_site
from problem_families.sites import Site, Stuff, district_site

FamilyKind = Literal["district", "office"]

CARRIERS: Final = (0.9e9, 2.1e9, 3.5e9, 4e9, 5.9e9, 10e9)  # [Hz]
PARAMETERS: Final = (2, 8)  # least and most
LINKS: Final = (20, 200)
NOISE_DB: Final = (1.0, 4.0)
OFFSET_DB: Final = 3.0  # standard deviation of a transmitter's offset
UPPER_PERMITTIVITY: Final = (9.0, 15.0)
CONDUCTIVITIES: Final = (1e-3, 1.0)  # [S/m], bounds of the search
HALF_SPACE: Final = 100.0
"""Thickness of a slab whose far side no wave comes back from, at the conductivities that occur [m]."""

DRAWN: Final = 2.5
"""Links drawn for each one kept: some of them no path leads to."""

ONE_SIDED: Final = 8
"""Of the links that the engine reaches and the cheap model does not, one of so many is kept."""

SAMPLES: Final = 100_000
DIFFUSE_SAMPLES: Final = 1_000
WEAK: Final = 0.003
"""Share of a link's power below which a path is left out, to make an evaluation quick."""

PROBES: Final = 8
STARTS: Final = 64
"""Local searches for the global optimum; its file says how many."""


class Told(NamedTuple):
    """What an optimizer is told of points of the search space."""

    value: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None


@dataclass(frozen=True)
class Differences:
    """What the engine has that the cheap model lacks.

    Attributes:
        depth: Most interactions of a path, engine and cheap model.
        diffraction: Whether the engine diffracts.
        diffuse_reflection: Whether its surfaces scatter.
        half_space: Whether its walls have one face (Fresnel's coefficients) where the cheap model has slabs.
        antennas: Whether its antennas are dipoles where the cheap model has isotropic ones.
        position_error: Standard deviation between their positions, in x and y [m].
        misinformed: Whether the cheap model is told wrong thicknesses and conductivities.
    """

    depth: tuple[int, int]
    diffraction: bool
    diffuse_reflection: bool
    half_space: bool
    antennas: bool
    position_error: float
    misinformed: bool


@dataclass(frozen=True, eq=False)
class PlantedProblem:
    """One problem of a family; the search space is that of `parameters`.

    Attributes:
        kind: "district" or "office".
        seed: Its seed.
        frequency: Carrier [Hz].
        parameters: What is calibrated, with bounds [d]; they own the search space.
        engine: The expensive engine.
        cheap: The cheap model: the same parameters on the paths of a simpler trace, +inf for a link that it has no path
            to. `cheap.paths` are those, and the materials that it was told; a `Replay` of them has exact derivatives.
        differences: What the engine has that the cheap model lacks.
        measured: Measured path loss [L], [dB].
        station: Transmitter of each link [L].
        offsets: Whether every transmitter's measurements have an unknown offset.
        noise_db: Standard deviation of the noise [dB].
        truth: The planted candidate [d], in the fields' units.
    """

    kind: FamilyKind
    seed: int
    frequency: float
    parameters: Parameters
    engine: Direct
    cheap: Direct
    differences: Differences
    measured: NDArray[np.float64]
    station: NDArray[np.int64]
    offsets: bool
    noise_db: float
    truth: NDArray[np.float64]

    @property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds of the search space [d]."""
        return self.parameters.search_bounds[0]

    @property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds of the search space [d]."""
        return self.parameters.search_bounds[1]

    def evaluate(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ask the engine.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB].
        """
        return self.engine.path_loss(candidates)

    def cheap_rmse_db(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """RMSE of the cheap model at points of the search space, over the links that it reaches.

        Args:
            points: Points of the search space [n, d].

        Returns:
            RMSE [n], [dB].
        """
        loss = self.cheap.path_loss(self.parameters.from_search(points))
        reached = np.isfinite(loss)
        residuals = self.residuals(np.where(reached, loss, self.measured))
        return np.sqrt(np.sum(residuals**2 * reached, axis=1) / np.maximum(reached.sum(axis=1), 1))

    def residuals(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss less the measurements, each transmitter's best offset taken out where there are offsets.

        Args:
            path_loss: Of any model [n, L], [dB].

        Returns:
            Residuals [n, L], [dB].
        """
        return self._without_offsets(path_loss - self.measured)

    def told(self, points: NDArray[np.float64], derivatives: bool = False) -> Told:
        """What an optimizer is told.

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
        return Told(np.sqrt(np.mean(residuals**2, axis=1)), residuals, jacobian)

    @property
    def fingerprint(self) -> str:
        """All that the engine's answers and their residuals depend on, as SHA-256 in hexadecimal."""
        digest = hashlib.sha256(json.dumps([self.kind, self.offsets, self.parameters.names]).encode())
        middle = self.told(0.5 * (self.lower + self.upper)[None]).residuals
        # Derived numbers may differ by rounding between machines.
        for part in (self.lower, self.upper, self.measured, self.station, middle):
            digest.update(np.round(part, 6).astype("<f8").tobytes())
        return digest.hexdigest()

    @property
    def minimum_rmse_db(self) -> float:
        """The lowest RMSE over the bounds [dB], found by least squares from `STARTS` points and then kept on disk."""
        known = optima.find(self.fingerprint, STARTS)
        if known is not None:
            return known
        search = LeastSquares(self.lower, self.upper, starts=STARTS, x0=self.parameters.to_search(self.truth))
        while not search.done:
            points = search.ask()
            told = self.told(points, derivatives=True)
            search.tell(points, told.value, residuals=told.residuals, jacobian=told.jacobian)
        optima.keep(self.fingerprint, STARTS, search.best.y)
        return search.best.y

    def _without_offsets(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rows over the links [..., L] less each transmitter's mean, where there are offsets."""
        if not self.offsets:
            return rows
        share = (self.station == np.arange(self.station.max() + 1)[:, None]).astype(np.float64)
        means = rows @ (share / share.sum(axis=1, keepdims=True)).T
        return rows - means[..., self.station]


def problem(seed: int, kind: str = "district") -> PlantedProblem:
    """Draw a problem.

    The first call traces, in some tens of seconds; traces are kept (`calibray.tracing.cache`).

    Args:
        seed: Its seed; 1000 and beyond are for judging.
        kind: "district" or "office".

    Returns:
        The problem.

    Raises:
        InputError: There is no such kind, the seed is negative, or nothing can trace.
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
    truth = {name: _material(stuff, frequency, differences, rng) for name, stuff in site.stuffs.items()}
    rich, poor = _traced(site, truth, frequency, differences, rng)
    kept = _kept(rich, poor)[:count]
    rich, poor = take_links(rich, kept), take_links(poor, kept)
    parameters = _parameters(truth, frequency, rng)
    planted = np.array([getattr(truth[item.material], item.field) for item in parameters])
    engine = _without_weak_paths(rich, parameters)
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
        _without_weak_paths(poor, parameters),
        differences,
        engine.path_loss(planted[None])[0] + error,
        station,
        offsets,
        noise,
        planted,
    )


def _kept(rich: Paths, poor: Paths) -> NDArray[np.int64]:
    """Links that the engine reaches, most of which the cheap model reaches too."""
    engine, cheap = (np.bincount(paths.link, minlength=paths.num_links) > 0 for paths in (rich, poor))
    return np.flatnonzero(engine & (cheap | (np.arange(len(engine)) % ONE_SIDED == 0)))


def _without_weak_paths(paths: Paths, parameters: Parameters) -> Direct:
    """The program without paths that hold less than `WEAK` of their link's power at every one of some candidates."""
    whole = Direct(paths, parameters)
    unit = design("sobol", PROBES, len(parameters), np.random.default_rng(0))
    power = whole.path_powers(parameters.from_unit(unit))
    link = np.zeros((len(power), paths.num_links))
    np.add.at(link.T, paths.link, power.T)
    strong = (power >= WEAK * link[:, paths.link]).any(axis=0)
    return Direct(take(paths, np.flatnonzero(strong)), parameters)


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
        misinformed=bool(draw[6] < 0.5),
    )


def _material(stuff: Stuff, frequency: float, differences: Differences, rng: np.random.Generator) -> Material:
    """The true constants of a material, as the engine has them."""
    conductivity = float(np.exp(rng.uniform(*np.log(stuff.conductivity)))) * frequency / 4e9
    thickness, scattering = rng.uniform(*stuff.thickness), rng.uniform(*stuff.scattering_coefficient)
    return Material(
        float(rng.uniform(*stuff.relative_permittivity)),
        conductivity,
        HALF_SPACE if differences.half_space else float(thickness),
        float(scattering) if differences.diffuse_reflection else 0.0,
    )


def _told(
    site: Site, truth: Mapping[str, Material], differences: Differences, rng: np.random.Generator
) -> dict[str, Material]:
    """The materials as the cheap model is told them: they do not scatter, and have two faces."""
    told = {}
    for name, material in truth.items():
        thickness = (
            float(rng.uniform(*site.stuffs[name].thickness)) if differences.half_space else material.thickness
        )
        wrong, decades = rng.uniform(0.3, 1.7), rng.uniform(-0.5, 0.5)
        factor = (float(wrong), float(10.0**decades)) if differences.misinformed else (1.0, 1.0)
        told[name] = Material(
            material.relative_permittivity, material.conductivity * factor[1], thickness * factor[0]
        )
    return told


def _traced(
    site: Site,
    truth: Mapping[str, Material],
    frequency: float,
    differences: Differences,
    rng: np.random.Generator,
) -> tuple[Paths, Paths]:
    """The paths of the engine and of the cheap model."""
    told = _told(site, truth, differences, rng)
    moved = _Links(*(_moved(ends, differences.position_error, rng) for ends in (site.tx, site.rx)))
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
        rich = _paths(scene, truth, moved, frequency, base, dipole)
        if differences.diffuse_reflection:
            scattering = replace(
                base, max_depth=2, diffraction=False, diffuse_reflection=True, samples=DIFFUSE_SAMPLES
            )
            mixed = _paths(scene, truth, moved, frequency, scattering, dipole)
            diffuse = np.add.reduceat(
                np.append(mixed.kind == InteractionKind.DIFFUSE, False), mixed.first[:-1]
            )
            diffuse = np.where(np.diff(mixed.first) > 0, diffuse, 0)
            rich = concatenate([rich, take(mixed, np.flatnonzero(diffuse))])
        return rich, _paths(scene, told, _Links(site.tx, site.rx), frequency, cheap, simple)


@dataclass(frozen=True)
class _Links:
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]


def _moved(ends: NDArray[np.float64], error: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Ends of links [n, 3], [m], displaced in the plan; those that stand together stay together."""
    places, owner = np.unique(ends, axis=0, return_inverse=True)
    step = np.clip(rng.standard_normal((len(places), 2)), -2.0, 2.0)
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
    digest = cache.trace_digest(
        SIONNA.versions, scene, frequency, settings, (antenna, antenna), links.tx, links.rx
    )
    paths = cache.load_trace(digest)
    if paths is None:
        paths = SIONNA(scene, frequency, settings, antenna, antenna).trace(links)
        cache.store_trace(digest, paths)
    return paths


def _parameters(truth: Mapping[str, Material], frequency: float, rng: np.random.Generator) -> Parameters:
    """What is calibrated: permittivities first, then conductivities."""
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
