"""Scenes on which replay is compared with Sionna RT's own field stage, and the comparison itself.

Both sides start from the same stored paths. Sionna computes their gains with its field stage in single
precision, replay with `calibray.path_gains` in double precision. `benchmarks/fidelity.py` prints what
`tests/tracing/test_fidelity.py` checks.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.constants import speed_of_light

from calibray.fields import jax_settings, path_gains, slab
from calibray.materials import SCATTERING_PATTERNS, Material
from calibray.paths import Kind, Paths
from calibray.scenarios import demo_study_path
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Trace, Tracer

PATH_BOUND = 1e-3  # relative error of a path gain
LOSS_BOUND = 0.01  # [dB], error of a link's path loss
RANGE = 1e-6  # paths weaker than this share of their link's strongest power (60 dB) are left out

MIXED = {"refraction": True, "diffraction": True, "edge_diffraction": True, "diffuse_reflection": True}
DATA = "data:"


@dataclass(frozen=True)
class Case:
    """One campaign to compare on.

    Attributes:
        scene: What `read_scene` takes, or `data:` and a file in the folder with measured data.
        frequency: [Hz].
        tx: Transmitter [m].
        low: One corner of the box that receivers are drawn from [m].
        high: The opposite corner [m].
        settings: Switches of the tracer.
        kinds: Kinds of interaction that the traced paths must contain, or the comparison shows nothing.
        receivers: Number of receivers.
        tx_antenna: Transmit antenna.
        rx_antenna: Receive antenna.
        exception: Why single precision keeps Sionna itself from `PATH_BOUND` here; empty where it does not.
    """

    scene: str
    frequency: float
    tx: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    settings: Mapping[str, int | bool] = field(default_factory=dict)
    kinds: frozenset[Kind] = frozenset(Kind)
    receivers: int = 5
    tx_antenna: Antenna = field(default_factory=lambda: Antenna("dipole", "V"))
    rx_antenna: Antenna = field(default_factory=Antenna)
    exception: str = ""


_STREET = ((-15.0, 30.0, 1.5), (105.0, 150.0, 1.5))
_BOULDER = (DATA + "nist_boulder/scene/scene.xml", 28.5e9, (0, 0, 2.5), (-100, -100, 1.6), (100, 100, 1.6))
_BOUNCES = frozenset({Kind.SPECULAR, Kind.DIFFUSE})

_TILTED, _ROLLED = (0.4, 0.2, 0.1), (2.5, -0.3, 0.7)  # [rad]

SCENES: dict[str, Case] = {
    "munich": Case("sionna:munich", 3.5e9, (8.5, 21, 27), *_STREET, {"max_depth": 2, **MIXED}),
    "etoile": Case(
        "sionna:etoile", 3.5e9, (8.5, 21, 27), *_STREET, {"max_depth": 2, **MIXED},
        tx_antenna=Antenna("hw_dipole", "VH"), rx_antenna=Antenna("dipole", "cross", _TILTED),
    ),
    "simple_street_canyon": Case(
        "sionna:simple_street_canyon", 3.5e9, (-20, 2, 15), (-8, -8, 1.5), (8, 8, 1.5), {"max_depth": 3, **MIXED}
    ),
    "double_reflector": Case(
        "sionna:double_reflector", 3.5e9, (-8, 0, 2), (5.7, -0.3, 0.8), (6.3, 0.3, 1.2),
        {"max_depth": 2, "diffuse_reflection": True}, _BOUNCES,
        tx_antenna=Antenna("tr38901", "cross", _TILTED), rx_antenna=Antenna("iso", "V", _ROLLED),
    ),
    "triple_reflector": Case(
        "sionna:triple_reflector", 3.5e9, (-8, 0, 2), (27.8, -0.3, 1.9), (28.2, 0.3, 2.1),
        {"max_depth": 3, "refraction": True}, frozenset({Kind.SPECULAR}),
        tx_antenna=Antenna("iso", "V"), rx_antenna=Antenna("tr38901", "H", _ROLLED),
    ),
    "box": Case(
        "sionna:box", 3.5e9, (1, -2, 2), (-4, -4, 1), (4, 4, 3),
        {"max_depth": 2, "diffuse_reflection": True}, _BOUNCES,
        tx_antenna=Antenna("dipole", "H", _TILTED), rx_antenna=Antenna("hw_dipole", "VH", _ROLLED),
    ),
    "box_one_screen": Case(
        "sionna:box_one_screen", 3.5e9, (-3, -2, 2), (1, -4, 1), (4, 4, 3),
        {"max_depth": 2, **MIXED},
    ),
    "floor_wall": Case(
        "sionna:floor_wall", 3.5e9, (-1.5, 0.3, 1.5), (0.5, -1.5, 0.5), (1.8, 1.5, 2),
        {"max_depth": 2, **MIXED},
    ),
    "simple_wedge": Case(
        "sionna:simple_wedge", 1e9, (-5, -10, 0), (8, 3, -2), (15, 8, 2),
        {"max_depth": 2, "refraction": True, "diffraction": True},
        frozenset({Kind.REFRACTION, Kind.DIFFRACTION}),
    ),
    "simple_wedge, in its shadow": Case(
        "sionna:simple_wedge", 1e9, (-5, -10, 0), (2, 1, -2), (15, 8, 2),
        {"max_depth": 2, "refraction": True, "diffraction": True, "diffraction_lit_region": False},
        frozenset({Kind.DIFFRACTION}),
    ),
    "coastal_district": Case(
        str(demo_study_path().with_name("scene") / "scene.xml"), 4e9, (-381.5, 140, 4), (-384, 180, 4), (-376, 420, 4),
        {"max_depth": 3, "diffuse_reflection": True}, _BOUNCES,
    ),
    "box_one_screen, through it at 28.5 GHz": Case(
        "sionna:box_one_screen", 28.5e9, (-3, -2, 2), (1, -4, 1), (4, 4, 3),
        {"max_depth": 2, "refraction": True}, frozenset({Kind.SPECULAR, Kind.REFRACTION}),
        exception="low-loss slabs many wavelengths thick",
    ),
}  # fmt: skip
"""The scenes; a further one is one entry."""

MEASURED: dict[str, Case] = {
    "auckland_tower": Case(
        DATA + "auckland_tower/scene/scene.xml", 1.88e9, (5, 13.5, 11), (1, 1, 10.5), (17, 17, 11.5),
        {"max_depth": 2, **MIXED},
    ),
    "nist_boulder": Case(
        *_BOULDER, {"max_depth": 2, **MIXED, "refraction": False}, frozenset(Kind) - {Kind.REFRACTION}
    ),
    "nist_boulder, through walls": Case(
        *_BOULDER, {"max_depth": 2, "refraction": True}, frozenset({Kind.SPECULAR, Kind.REFRACTION}),
        exception="low-loss slabs many wavelengths thick",
    ),
}  # fmt: skip
"""Scenes of measured campaigns, which are no part of the repository: for `benchmarks/fidelity.py`."""


@dataclass(frozen=True)
class Campaign:
    """A traced case: the tracer, Sionna's stored paths, and the compiled program."""

    case: Case
    tracer: Tracer
    trace: Trace
    paths: Paths


@dataclass(frozen=True)
class Errors:
    """How far replay is from Sionna.

    Attributes:
        path: Relative error of every path gain, 0 for paths too weak to count [P].
        allowed: Bound of each path's error [P].
        loss_db: Error of every link's path loss [L], [dB].
        allowed_db: Bound of each link's error [L], [dB].
        counted: Number of paths compared.
    """

    path: np.ndarray
    allowed: np.ndarray
    loss_db: np.ndarray
    allowed_db: np.ndarray
    counted: int

    @property
    def within(self) -> bool:
        """Whether all errors are within their bounds."""
        return bool((self.path <= self.allowed).all() and (self.loss_db <= self.allowed_db).all())

    def __str__(self) -> str:
        return (
            f"worst of {self.counted} paths {self.path.max(initial=0):.2e}, "
            f"{np.sum(self.path > self.allowed)} over their bound; worst link {self.loss_db.max():.5f} dB"
        )


def data_folder() -> Path:
    """The folder with measured data; it need not exist."""
    return Path(os.environ.get("CALIBRAY_DATA", Path(__file__).parents[2] / "shared" / "data"))


def run(case: Case, samples: int = 20_000) -> Campaign:
    """Trace a case.

    Scenes carry no scattering constants, so where diffuse reflection is on each material gets some, with the
    three scattering patterns in turn.

    Args:
        case: The case.
        samples: Rays sent out.

    Returns:
        The traced case.
    """
    source = case.scene.removeprefix(DATA)
    scene = read_scene(data_folder() / source if case.scene.startswith(DATA) else source, case.frequency)
    if case.settings.get("diffuse_reflection"):
        scene = replace(scene, materials=rough(scene.materials))
    settings = TraceSettings(samples=samples, **case.settings)
    tracer = Tracer(scene, case.frequency, settings, case.tx_antenna, case.rx_antenna)
    rx = np.random.default_rng(0).uniform(case.low, case.high, (case.receivers, 3))
    trace = tracer.find_paths(
        SimpleNamespace(tx=np.tile(np.array(case.tx, dtype=float), (len(rx), 1)), rx=rx)
    )
    return Campaign(case, tracer, trace, trace.paths())


def rough(materials: Mapping[str, Material]) -> dict[str, Material]:
    """The same materials with scattering, the patterns in turn."""
    patterns = list(SCATTERING_PATTERNS)
    return {
        name: replace(
            material, scattering_coefficient=0.4, xpd_coefficient=0.2, alpha_r=4, alpha_i=2, lambda_=0.7,
            scattering_pattern=patterns[index % 3],
        )
        for index, (name, material) in enumerate(materials.items())
    }  # fmt: skip


def changed(campaign: Campaign, seed: int) -> dict[str, Material]:
    """Other materials for a traced case, metals among them turned into building materials.

    Args:
        campaign: The traced case.
        seed: Seed of the changes.

    Returns:
        Permittivity, conductivity, thickness, scattering and cross-polarization all different; scattering
        stays off where it was off, as then no diffuse path was looked for.
    """
    random = np.random.default_rng(seed)
    return {
        name: replace(
            material,
            relative_permittivity=random.uniform(1.5, 12),
            conductivity=10 ** random.uniform(-2, -0.5) * campaign.case.frequency / 3.5e9,
            thickness=random.uniform(0.05, 0.4),
            scattering_coefficient=min(material.scattering_coefficient * random.uniform(0.5, 2), 1.0),
            xpd_coefficient=random.uniform(0, 0.5),
        )
        for name, material in campaign.paths.materials.items()
    }


def compare(campaign: Campaign, materials: Mapping[str, Material], program: Paths | None = None) -> Errors:
    """Compare replay with Sionna's field stage.

    Args:
        campaign: The traced case.
        materials: Materials to evaluate both with.
        program: Path program to replay in place of the campaign's, for tampering.

    Returns:
        The errors.
    """
    return difference(
        campaign,
        campaign.trace.path_gains(materials),
        path_gains(program or campaign.paths, materials),
        materials,
    )


def difference(
    campaign: Campaign, sionna: np.ndarray, replay: np.ndarray, materials: Mapping[str, Material]
) -> Errors:
    """Errors of path gains.

    Args:
        campaign: The traced case.
        sionna: Sionna's gains [P, R, T].
        replay: Gains to judge [P] or [P, R, T].
        materials: The materials they were computed with.

    Returns:
        The errors.
    """
    case, paths, replay = campaign.case, campaign.paths, replay.reshape(sionna.shape)
    power = (np.abs(sionna) ** 2).sum(axis=(1, 2))
    strongest = np.zeros(paths.num_links)
    np.maximum.at(strongest, paths.link, power)
    counted = power > RANGE * strongest[paths.link]
    error = np.zeros(paths.num_paths)
    error[counted] = np.sqrt((np.abs(replay - sionna) ** 2).sum(axis=(1, 2))[counted] / power[counted])
    excused = rounding(paths, materials) * counted if case.exception else np.zeros(paths.num_paths)
    excused_link = np.zeros(paths.num_links)
    np.maximum.at(excused_link, paths.link, excused)
    return Errors(
        path=error,
        allowed=PATH_BOUND + excused,
        loss_db=_loss_gap(paths, sionna, replay),
        allowed_db=LOSS_BOUND + 20 * np.log10(1 + excused_link),
        counted=int(counted.sum()),
    )


def _loss_gap(paths: Paths, sionna: np.ndarray, replay: np.ndarray) -> np.ndarray:
    """Difference of path loss [L], [dB]; 0 where both sides have no path."""
    powers = [
        np.bincount(paths.link, (np.abs(gain) ** 2).sum(axis=(1, 2)), paths.num_links)
        for gain in (sionna, replay)
    ]
    reached = (powers[0] > 0) | (powers[1] > 0)
    gap = np.zeros(paths.num_links)
    gap[reached] = np.abs(10 * np.log10(powers[1][reached] / powers[0][reached]))
    return gap


def rounding(paths: Paths, materials: Mapping[str, Material]) -> np.ndarray:
    """What single precision alone changes in Sionna's coefficients along each path.

    Sionna's function for slab coefficients is called at every interaction and compared with ours in double
    precision. Its complex square root forms sqrt((|z| - Re z) / 2), which cancels where losses are small, and
    the thickness in wavelengths multiplies the error.

    Args:
        paths: The path program.
        materials: Materials by name.

    Returns:
        Sum of the relative errors of the coefficients along each path [P].
    """
    import mitsuba as mi
    from sionna.rt.utils import complex_relative_permittivity, itu_coefficients_single_layer_slab

    constants = [materials[name] for name in paths.materials]
    column = {
        name: np.array([getattr(material, name) for material in constants])[paths.material]
        for name in ("relative_permittivity", "conductivity", "thickness")
    }
    wavelength = speed_of_light / paths.frequency
    transmitted = paths.kind == Kind.REFRACTION
    with jax_settings():
        exact = slab.coefficients(
            paths.cos_incidence, column["relative_permittivity"],
            slab.loss_term(column["conductivity"], wavelength), column["thickness"], wavelength, transmitted,
        )  # fmt: skip
    eta = complex_relative_permittivity(
        mi.Float(column["relative_permittivity"]),
        mi.Float(column["conductivity"]),
        mi.Float(2 * np.pi * paths.frequency),
    )
    single = itu_coefficients_single_layer_slab(
        mi.Float(paths.cos_incidence), eta, mi.Float(column["thickness"]), mi.Float(wavelength)
    )
    worst = np.zeros(paths.num_interactions)
    for polarization, (real, imaginary) in enumerate(exact):
        reference = np.asarray(real) + 1j * np.asarray(imaginary)
        r, t = (
            np.array(single[k].real) + 1j * np.array(single[k].imag) for k in (polarization, polarization + 2)
        )
        worst = np.maximum(worst, np.abs(np.where(transmitted, t, r) - reference) / np.abs(reference))
    total = np.concatenate([[0.0], np.cumsum(worst)])
    return total[paths.first[1:]] - total[paths.first[:-1]]
