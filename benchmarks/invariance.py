"""Results must not depend on names, order, place, direction or chunks: the largest change of each quantity.

    python benchmarks/invariance.py

A campaign of two masts, three houses and forty links is traced, calibrated and used for predictions, and again after
each transformation of `tests/invariance_cases.py`. The exit status is 1 if a change exceeds its tolerance.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


def main() -> int:
    """Print a table of the changes."""
    from invariance_cases import TOLERANCES, TRANSFORMATIONS, campaign, largest_changes, quantities

    exceeded = 0
    with tempfile.TemporaryDirectory() as folder:
        plain = campaign(Path(folder) / "plain")
        befores = {
            blocks: quantities(
                replace(plain, sections={} if blocks else {"holdout": None}), Path(folder) / str(blocks)
            )
            for blocks in (True, False)
        }
        print(f"{'transformation':22}{'quantity':18}{'largest change':>15}{'tolerance':>11}")
        for number, (name, transform) in enumerate(TRANSFORMATIONS.items()):
            changed = transform(plain)
            before = befores["holdout" not in changed.sections]
            after = quantities(changed, Path(folder) / str(number))
            for quantity, change in largest_changes(before, after).items():
                wrong = change > TOLERANCES[quantity]
                exceeded += wrong
                print(
                    f"{name:22}{quantity:18}{change:15.2g}{TOLERANCES[quantity]:11g}{'  exceeded' if wrong else ''}",
                    flush=True,
                )
    return int(exceeded > 0)


if __name__ == "__main__":
    sys.exit(main())
