"""Least-squares landscapes with exact derivatives: reflecting districts, sine tones, a curved valley.

The district imitates the calibration problem in a few lines. The gain of every link is the sum of the powers of 2 to 6
paths, and a path is the product of 1 to 3 reflections from dielectric slabs (ITU-R P.2040-3, eqs. 31, 37, 43) at 4 GHz.
The data are the path losses at planted permittivities with 3 dB of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.protocol import Optimizer

Array = NDArray[np.float64]
WAVELENGTH = 299_792_458.0 / 4e9  # [m]


@dataclass(frozen=True)
class Landscape:
    """Residuals over a box.

    Attributes:
        name: Name of the landscape.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        model: Function of points [n, d] that returns residuals [n, m] and the Jacobian [n, m, d].
        minimum: The lowest objective that any search has found.
    """

    name: str
    lower: Array
    upper: Array
    model: Callable[[Array], tuple[Array, Array]]
    minimum: float = np.nan

    def evaluate(self, x: Array) -> tuple[Array, Array, Array]:
        """Objective [n], residuals [n, m] and Jacobian [n, m, d]."""
        residuals, jacobian = self.model(x)
        return np.sqrt(np.mean(residuals**2, axis=1)), residuals, jacobian

    def value(self, x: Array) -> Array:
        """Objective [n]."""
        return self.evaluate(x)[0]

    def run(self, optimizer: Optimizer, budget: int | None = None) -> Optimizer:
        """Run an optimizer until it ends or has used its budget."""
        while not optimizer.done and (budget is None or optimizer.evaluations < budget):
            x = optimizer.ask()
            optimizer.tell(x, *self.evaluate(x))
        return optimizer


@dataclass(frozen=True)
class District:
    """Reflections of all paths of all links.

    Attributes:
        material: Material of each reflection [i].
        cosine: Cosine of the angle of incidence [i].
        te_share: Share of the incident power in TE polarization [i].
        first_of_path: Index of the first reflection of each path [p].
        path_gain_db: Free-space gain of each path [p].
        first_of_link: Index of the first path of each link [m].
        thickness: Slab thickness of each material [k], [m].
        conductivity: Conductivity of each material [k], [S/m].
    """

    material: NDArray[np.intp]
    cosine: Array
    te_share: Array
    first_of_path: NDArray[np.intp]
    path_gain_db: Array
    first_of_link: NDArray[np.intp]
    thickness: Array
    conductivity: Array

    @staticmethod
    def draw(links: int, materials: int, pane: float, rng: np.random.Generator) -> District:
        """Draw walls, panes and, as the last material, ground that is hit at grazing angles."""
        paths = rng.integers(2, 7, links)
        reflections = rng.integers(1, 4, paths.sum())
        count = reflections.sum()
        material = rng.integers(0, materials, count)
        grazing = material == materials - 1
        return District(
            material=material,
            cosine=np.where(grazing, rng.uniform(0.02, 0.3, count), rng.uniform(0.1, 1.0, count)),
            te_share=rng.uniform(0.0, 1.0, count),
            first_of_path=np.concatenate([[0], np.cumsum(reflections)[:-1]]),
            path_gain_db=rng.uniform(-110.0, -95.0, paths.sum()),
            first_of_link=np.concatenate([[0], np.cumsum(paths)[:-1]]),
            thickness=np.resize([0.3, pane, 0.3], materials),
            conductivity=np.resize([0.137, 0.023, 0.05], materials),
        )

    def path_loss(self, permittivity: Array) -> tuple[Array, Array]:
        """Path loss [n, m], [dB], for permittivities [n, k], and its derivatives [n, m, k]."""
        power, slope = self._reflected_power(permittivity[:, self.material])
        log_path = np.add.reduceat(np.log(power), self.first_of_path, axis=1)
        path = 10.0 ** (self.path_gain_db / 10.0) * np.exp(log_path)
        link = np.add.reduceat(path, self.first_of_link, axis=1)
        per_material = (np.arange(len(self.thickness)) == self.material[:, None]) * (slope / power)[
            :, :, None
        ]
        d_path = path[:, :, None] * np.add.reduceat(per_material, self.first_of_path, axis=1)
        d_link = np.add.reduceat(d_path, self.first_of_link, axis=1)
        return -10.0 * np.log10(link), -10.0 / np.log(10.0) * d_link / link[:, :, None]

    def _reflected_power(self, permittivity: Array) -> tuple[Array, Array]:
        """Power reflection factor and its derivative with respect to the permittivity [n, i]."""
        loss = 1j * self.conductivity[self.material] * WAVELENGTH * 59.96  # sigma / (2 pi f eps_0)
        power, slope = 0.0, 0.0
        for share, te in ((self.te_share, True), (1.0 - self.te_share, False)):
            here, step = self._slab(permittivity - loss, te), 1e-6 * permittivity
            # The factor is analytic in the permittivity, so a central difference along the real axis is sufficient.
            there = self._slab(permittivity + step - loss, te) - self._slab(permittivity - step - loss, te)
            power = power + share * np.abs(here) ** 2
            slope = slope + share * 2.0 * np.real(np.conj(here) * there / (2.0 * step))
        return power, slope

    def _slab(self, eta: NDArray[np.complex128], te: bool) -> NDArray[np.complex128]:
        root = np.sqrt(eta - (1.0 - self.cosine**2))
        weight = 1.0 if te else eta
        half_space = (weight * self.cosine - root) / (weight * self.cosine + root)
        q = 2.0 * np.pi * self.thickness[self.material] / WAVELENGTH * root
        decay = np.exp(-2j * q)
        return np.asarray(half_space * (1.0 - decay) / (1.0 - half_space**2 * decay), dtype=np.complex128)


@cache
def district(materials: int = 3, links: int = 40, pane: float = 0.1, seed: int = 7) -> Landscape:
    """Permittivities fitted to path losses with 3 dB of noise; panes of 0.1 m resonate, which gives many minima."""
    rng = np.random.default_rng(seed)
    world = District.draw(links, materials, pane, rng)
    truth = rng.uniform(3.0, 8.0, materials)
    measured = world.path_loss(truth[None])[0][0] + 3.0 * rng.standard_normal(links)

    def model(x: Array) -> tuple[Array, Array]:
        loss, jacobian = world.path_loss(x)
        return loss - measured, jacobian

    return Landscape(
        f"district-{materials}-{pane:g}", np.full(materials, 1.5), np.full(materials, 15.0), model
    )


def street() -> Landscape:
    """A district of thin panes, which do not resonate: few local minima, as in scenes of thin glass."""
    return replace(district(pane=0.02, seed=1), name="street", minimum=2.97426794)


def blocks() -> Landscape:
    """Eight materials of thin panes and walls, with 60 links."""
    return replace(district(8, 60, pane=0.02, seed=1), name="blocks", minimum=2.77408251)


def hall() -> Landscape:
    """A district of thick panes, which resonate: hundreds of local minima."""
    return replace(district(), name="hall", minimum=3.10757421)


@cache
def tones() -> Landscape:
    """Frequencies and phase of two sine tones in noise, with a series of local minima next to the global one."""
    rng = np.random.default_rng(3)
    time = np.sort(rng.uniform(0.0, 1.0, 30))

    def signal(x: Array) -> tuple[Array, Array]:
        first = 2.0 * np.pi * x[:, :1] * time + x[:, 2:]
        second = 2.0 * np.pi * x[:, 1:2] * time
        slopes = (2.0 * np.pi * time * np.cos(first), np.pi * time * np.cos(second), np.cos(first))
        return np.sin(first) + 0.5 * np.sin(second), np.stack(slopes, axis=-1)

    data = signal(np.array([[5.3, 2.1, 0.8]]))[0][0] + 0.3 * rng.standard_normal(30)

    def model(x: Array) -> tuple[Array, Array]:
        value, jacobian = signal(x)
        return value - data, jacobian

    return Landscape("tones", np.array([1.0, 1.0, -np.pi]), np.array([9.0, 9.0, np.pi]), model, 0.29150708)


@cache
def rosenbrock() -> Landscape:
    """The curved valley, with its minimum of 0 at (1, 1)."""

    def model(x: Array) -> tuple[Array, Array]:
        a, b = x.T
        one, zero = np.ones_like(a), np.zeros_like(a)
        jacobian = np.stack([np.stack([-20.0 * a, 10.0 * one], -1), np.stack([-one, zero], -1)], 1)
        return np.stack([10.0 * (b - a**2), 1.0 - a], -1), jacobian

    return Landscape("rosenbrock", np.array([-2.0, -2.0]), np.array([2.0, 2.0]), model, 0.0)


def within(landscape: Landscape, lower: list[float], upper: list[float]) -> Landscape:
    """The same residuals over a different box."""
    return replace(landscape, lower=np.array(lower), upper=np.array(upper))
