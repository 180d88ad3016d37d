"""The demo: a coastal high-rise district like that of the paper, with a simulated measurement campaign.

The folder `coastal_district/` contains its files. In the repository, `python benchmarks/demo_campaign.py FOLDER`
regenerates them.
"""

from pathlib import Path


def demo_study_path() -> Path:
    """The path of the demo's `study.toml`; its folder also contains the scene, the links and the true parameters.

    Example:
        >>> sorted(path.name for path in demo_study_path().parent.iterdir())
        ['links.csv', 'scene', 'study.toml', 'truth.json']
    """
    return Path(__file__).with_name("coastal_district") / "study.toml"
