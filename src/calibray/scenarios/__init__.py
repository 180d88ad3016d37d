"""The demo: a coastal high-rise district like that of the paper, and a simulated measurement campaign.

`district` builds streets and buildings, `world` plants the true constants, and `campaign` measures the links and
writes the files. `python -m calibray.scenarios FOLDER` generates them again; `coastal_district/` contains them.
"""

from pathlib import Path


def demo_study_path() -> Path:
    """The `study.toml` of the demo district, in the folder of its scene, its links and the truth.

    Example:
        >>> sorted(path.name for path in demo_study_path().parent.iterdir())
        ['links.csv', 'scene', 'study.toml', 'truth.json']
    """
    return Path(__file__).with_name("coastal_district") / "study.toml"
