"""All kinds of input, each with its share of the cases, and a case by its number."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from random import Random

from fuzzing import accidents, geometry, inputs, making, maps, outside, radio, stored, workbooks
from fuzzing.outcome import Case
from fuzzing.world import World

SHARES = {
    inputs.study: 22,
    inputs.row_filter: 12,
    inputs.table: 14,
    geometry.scene: 8,
    geometry.mesh: 8,
    geometry.moved: 2,
    geometry.antenna: 7,
    stored.paths: 9,
    stored.cache: 3,
    stored.ledger: 4,
    stored.result: 8,
    outside.answer: 2,
    outside.line: 7,
    workbooks.workbook: 5,
    maps.coverage: 3,
    making.making: 4,
    accidents.name: 4,
    accidents.occupied: 4,
    accidents.elsewhere: 2,
    accidents.repeats: 2,
    accidents.bomb: 2,
    accidents.terrain: 4,
    accidents.polyline: 2,
    radio.section: 6,
    radio.pattern: 3,
    radio.rays: 4,
}
"""Cases of each kind of a hundred or so."""


def make(seed: int, number: int, found: World, folder: Path, names: Collection[str] = ()) -> Case:
    """A case: the same for the same seed and number, wherever it is made.

    Args:
        seed: The seed of the suite.
        number: Number of the case.
        found: The world.
        folder: An empty folder for the case's files.
        names: Names of the kinds to choose from; all if empty.

    Returns:
        The case.
    """
    rng = Random(f"{seed}/{number}")
    shares = {kind: share for kind, share in SHARES.items() if not names or kind.__name__ in names}
    kind = rng.choices(list(shares), list(shares.values()))[0]
    return kind(rng, found, folder)
