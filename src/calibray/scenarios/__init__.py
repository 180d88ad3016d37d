"""The embedded demo: a coastal high-rise district like the paper's, and a measuring campaign simulated in it.

`district` builds streets and buildings, `world` plants the truth, `sounder` measures a link, and `campaign`
writes all of it down; `python -m calibray.scenarios FOLDER` does so anew. The outcome is packaged in
`coastal_district/`.
"""

from pathlib import Path


def demo_study_path() -> Path:
    """The study file of the demo district, packaged beside its scene, its links and its truth.

    Returns:
        Path of `study.toml`.

    Example:
        >>> sorted(path.name for path in demo_study_path().parent.iterdir())
        ['links.csv', 'scene', 'study.toml', 'truth.json']
    """
    return Path(__file__).with_name("coastal_district") / "study.toml"
