"""Hold out blocks of links in turn, calibrate on the other links, and print the RMSE on each block.

Usage: `python examples/cross_validation.py examples/nist_boulder.toml`

Every link is held out once, together with its neighbours. The scene is traced only once, with the initial materials,
not again with the calibrated ones. `calibray validate` does the same with blocks of equal size.
"""

from __future__ import annotations

import sys
from pathlib import Path

import calibray as cb
from calibray.tables import Column, Table, numbers, render

BLOCKS = {
    "nist_boulder": {  # from west to east along the street in sight, and from near to far along the other street
        "1": "(set == 'LOS' and rx_x_m < -8) or (set == 'NLOS' and rx_y_m < 45)",
        "2": "(set == 'LOS' and -8 <= rx_x_m < 8) or (set == 'NLOS' and 45 <= rx_y_m < 80)",
        "3": "(set == 'LOS' and rx_x_m >= 8) or (set == 'NLOS' and rx_y_m >= 80)",
    },
    "auckland_tower": {  # quadrants of the floor
        "south-west": "rx_x_m < 9.25 and rx_y_m < 9.25",
        "south-east": "rx_x_m >= 9.25 and rx_y_m < 9.25",
        "north-west": "rx_x_m < 9.25 and rx_y_m >= 9.25",
        "north-east": "rx_x_m >= 9.25 and rx_y_m >= 9.25",
    },
}
COLUMNS = (
    Column("RMSE [dB] of the held-out block"),
    *map(numbers, ("links", "before", "offset only", "after", "log-distance model")),
)


def main(file: str) -> None:
    """Cross-validate a study.

    Args:
        file: The study file; its name must be in `BLOCKS`.
    """
    study = cb.Study.load(file)
    engine = cb.engines.make(study)
    rows = []
    for name, where in BLOCKS[Path(file).stem].items():
        content = study.content() | {"holdout": {"where": where}, "fidelity": {"rounds": 0}}
        result = cb.calibrate(cb.Study.from_content(content, file), engine=engine)
        scores = (
            result.accuracy.initial_holdout_rmse_db,
            result.accuracy.nuisance_only_holdout_rmse_db,
            result.holdout_rmse_db,
            result.accuracy.log_distance_holdout_rmse_db,
        )
        rows.append((name, str(result.links.held_out.sum()), *(f"{score:.2f}" for score in scores)))
        values = (result.parameters | result.nuisance.offsets_db).items()
        sys.stderr.write(f"{name}: " + ", ".join(f"{key} {value:.3g}" for key, value in values) + "\n")
    sys.stdout.write(render(Table("", COLUMNS, tuple(rows))) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
