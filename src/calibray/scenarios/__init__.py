"""The demo: a coastal high-rise district like that of the paper, and a simulated measurement campaign.

`coastal_district/` contains its files. In the repository, `python benchmarks/demo_campaign.py FOLDER` makes them again.
"""

from pathlib import Path


def demo_study_path() -> Path:
    """The `study.toml` of the demo district, in the folder of its scene, its links and the truth.

    Example:
        >>> sorted(path.name for path in demo_study_path().parent.iterdir())
        ['links.csv', 'scene', 'study.toml', 'truth.json']
    """
    return Path(__file__).with_name("coastal_district") / "study.toml"
