"""The search for a region of extra loss that a scene lacks, with planted belts and without."""

import numpy as np
import pytest
import shapely

from calibray.scenes.obstruction import Region
from calibray.uncertainty import missing_region as room
from calibray.uncertainty.missing_region import missing_region

BELT = shapely.box(-42, -90, -30, -10)


def links(seed: int, count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Receivers around two masts, and 3 dB of noise."""
    random = np.random.default_rng(seed)
    rx = np.column_stack([random.uniform(-120, 120, (count, 2)), np.full(count, 1.5)])
    tx = np.array([[-105, 0, 30.0], [105, 10, 25.0]])[np.arange(count) % 2]
    return tx, rx, random.normal(0, 3, count)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_planted_belt_is_found_with_its_loss(seed):
    tx, rx, noise = links(seed)
    length = Region(np.array([BELT]), np.zeros(1), np.full(1, 10.0)).length_inside(tx, rx)
    slope = 5 * np.log10(np.linalg.norm(rx - tx, axis=1))
    found = missing_region(tx, rx, noise + 0.8 * length + slope)
    assert found.significant
    box = shapely.box(*found.box)
    assert shapely.area(shapely.intersection(box, BELT)) > 0.4 * shapely.area(BELT)
    assert found.height == pytest.approx(11.5)  # 10 m above the lowest antenna
    # A rectangle wider than the belt loses less per length.
    assert 0.25 < found.attenuation < 1.2
    assert found.share > 3 * found.chance
    crossed = Region(np.array([box]), np.full(1, -9.0), np.full(1, found.height)).length_inside(tx, rx) > 1.0
    assert found.links == pytest.approx(crossed.sum(), abs=2)


def test_without_a_belt_chance_is_exceeded_as_rarely_as_stated():
    alarms = [missing_region(*links(seed)[:2], links(seed)[2]).significant for seed in range(10, 22)]
    assert sum(alarms) <= 1  # 1 in 100 each


def test_a_loss_that_another_column_explains_is_no_region():
    tx, rx, noise = links(3)
    behind = (np.abs(rx[:, 0]) < 60).astype(float)
    assert missing_region(tx, rx, noise + 9 * behind).significant
    assert not missing_region(tx, rx, noise + 9 * behind, [behind]).significant


def test_few_links_or_no_residuals_are_not_searched():
    tx, rx, noise = links(4, 20)
    assert missing_region(tx, rx, noise) is None
    tx, rx, noise = links(4)
    assert missing_region(tx, rx, 0 * noise) is None


def test_the_number_of_crossing_links_refers_to_all_links(monkeypatch):
    """Repeated links, of which every fourth one is searched: four times as many cross the same rectangle."""
    tx, rx, noise = links(0)
    length = Region(np.array([BELT]), np.zeros(1), np.full(1, 10.0)).length_inside(tx, rx)
    excess_db = noise + 0.8 * length
    once = missing_region(tx, rx, excess_db)
    monkeypatch.setattr(room, "MOST", len(tx))
    repeated = missing_region(*(np.repeat(part, 4, axis=0) for part in (tx, rx, excess_db)))
    assert repeated.box == once.box
    assert repeated.links == 4 * once.links
