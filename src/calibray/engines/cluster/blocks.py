"""Replay of links in blocks: each is traced and compiled where it lives and stays there.

Candidates go out, and what is wanted of a block's path loss comes back: with `reducing` some sums, whatever the number
of its links. Blocks follow from the study alone, never from the machines, and so does every number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.cluster.partition import Shared, chosen, itself
from calibray.engines.cluster.workers import Crew
from calibray.engines.protocol import Differentiable, Reduced, Reduction, check_candidates
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.study.setup import Setup

Open = Callable[["Setup", Mapping[str, Material]], Differentiable]
"""The opened study of a block's links, and materials to trace with, to the engine over them."""

_TRACING: Final = Lock()
"""A process traces one block at a time."""


@dataclass(frozen=True, eq=False)
class Recipe:
    """What a block is made of.

    Attributes:
        shared: The opened study.
        links: The block's links.
        materials: Materials to trace with in place of the scene's, by name.
        open: Opens the engine over the links.
    """

    shared: Shared[Setup]
    links: Measurements
    materials: Mapping[str, Material]
    open: Open


@final
class Block:
    """Links that are traced and evaluated together. What is sent of it is its recipe.

    Args:
        recipe: What it is made of.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        with _TRACING:
            self.engine = recipe.open(recipe.shared.content.at(recipe.links), recipe.materials)

    def __reduce__(self) -> tuple[Any, ...]:
        return Block, (self._recipe,)


@final
class Blocks:
    """Links in blocks, evaluated for any candidate where they live; they are opened at once.

    Args:
        crew: Where they live.
        setup: The opened study.
        blocks: Links of every block; together they hold every link once.
        opening: Opens the engine over a block's links; a function that can be sent.
        materials: Materials to trace with in place of the scene's, by name.
        progress: Called with the stage "tracing" whenever a block is open.

    Attributes:
        blocks: Links of every block.
        calls: Candidates evaluated.
        parameters: What the candidates' components stand for.
        materials: The materials before calibration, as traced with.
    """

    def __init__(
        self,
        crew: Crew,
        setup: Setup,
        blocks: Sequence[NDArray[np.int64]],
        opening: Open,
        materials: Mapping[str, Material] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._crew, self._setup, self._open = crew, setup, opening
        self.blocks, self.calls, self.parameters = blocks, 0, setup.parameters
        self.materials = {**setup.scene.materials, **(materials or {})}
        links = [chosen(setup.links, each) for each in blocks]
        shared, done = Shared(setup.at(links[0])), 0

        def traced(index: int) -> None:
            nonlocal done
            done += len(blocks[index])
            if progress is not None:
                progress("tracing", done, len(setup.links))

        self._kept = crew.keep(Block, [Recipe(shared, each, materials or {}, opening) for each in links])
        sizes = crew.ask(_size, [self._kept], answered=traced)
        self.interactions = sum(interactions for interactions, _ in sizes)
        self.large = any(large for _, large in sizes)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), len(self._setup.links)))
        for links, part in zip(self.blocks, self._crew.ask(_path_loss, [self._kept], given), strict=True):
            loss[:, links] = part
        self.calls += len(given)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters, all brought here.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), len(self._setup.links)))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for links, part in zip(self.blocks, self._crew.ask(_jacobian, [self._kept], given), strict=True):
            loss[:, links], jacobian[:, links] = part
        self.calls += len(given)
        return loss, jacobian

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """What reduces the path loss of every block where that lives; see `Parted.reducing`."""
        kept = self._crew.keep(itself, reductions)

        def reduced(candidates: NDArray[np.float64], derivatives: bool) -> list[Any]:
            given = check_candidates(candidates, len(self.parameters))
            self.calls += len(given)
            return self._crew.ask(_reduced, [self._kept, kept], given, derivatives)

        return reduced

    def traced_with(self, materials: Mapping[str, Material], progress: Progress | None = None) -> Blocks:
        """The same on paths traced with other materials; see `Parted.traced_with`."""
        return Blocks(self._crew, self._setup, self.blocks, self._open, materials, progress)


def _size(block: Block) -> tuple[int, bool]:
    return block.engine.interactions, block.engine.large


def _path_loss(block: Block, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    return block.engine.path_loss(candidates)


def _jacobian(
    block: Block, candidates: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return block.engine.path_loss_and_jacobian(candidates)


def _reduced(
    block: Block, reduction: Reduction, candidates: NDArray[np.float64], derivatives: bool
) -> object:
    if derivatives:
        return reduction(*block.engine.path_loss_and_jacobian(candidates))
    return reduction(block.engine.path_loss(candidates), None)
