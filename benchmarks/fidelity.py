"""How closely replay agrees with Sionna RT's own field stage on the same stored paths, scene by scene.

    CALIBRAY_DATA=FOLDER python benchmarks/fidelity.py

The scenes and the comparison are those of the tests (tests/fidelity_cases.py), and the scenes of the measured campaigns
in FOLDER. Paths are evaluated with the materials of the trace, and then twice with all materials changed at random.
Only paths within 60 dB of their link's strongest path count. The exit status is 1 if an error exceeds its bound.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fidelity_cases import MEASURED, SCENES, changed, compare, data_folder, run


def main() -> None:
    """Measure and print a Markdown table."""
    print("| scene | paths compared | worst path, relative | worst link [dB] |")
    print("|---|---|---|---|")
    within = True
    for name, case in {**SCENES, **MEASURED}.items():
        if name in MEASURED and not data_folder().is_dir():
            print(f"| {name} | no data | | |")
            continue
        campaign = run(case)
        found = [compare(campaign, materials) for materials in
                 (campaign.paths.materials, changed(campaign, 1), changed(campaign, 2))]  # fmt: skip
        within = within and all(errors.within for errors in found)
        worst = max(errors.path.max(initial=0) for errors in found)
        link = max(errors.loss_db.max(initial=0) for errors in found)
        print(
            f"| {name} | {sum(errors.counted for errors in found)} | {worst:.1e} | {link:.5f} |", flush=True
        )
    if not within:
        sys.exit("An error exceeds its bound")


if __name__ == "__main__":
    main()
