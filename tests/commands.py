"""Commands run in this process, and studies as files for them."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import Result
from typer.testing import CliRunner

from calibray.cli.app import app
from calibray.uncertainty import sequential_monte_carlo as sampler

SCENE = """<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="mat-walls"><string name="type" value="brick"/></bsdf>
  <shape type="ply" id="mesh-house"><string name="filename" value="house.ply"/><ref id="mat-walls" name="bsdf"/></shape>
</scene>
"""
MESH = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
-50 5 0
50 5 0
0 5 40
3 0 1 2
"""
LINKS = "x,y,loss,half\n10,0,70.0,a\n20,0,76.0,b\n30,1,80.0,b\n"
STUDY = """version = 1
[scene]
file = "scene.xml"
frequency = 3.5e9
[links]
file = "links.csv"
tx = [0.0, 0.0, 2.0]
rx = ["x", "y", 1.5]
value = "loss"
[trace]
max_depth = 1
samples = 1000
[parameters]
"walls.relative_permittivity" = { bounds = [1.5, 12.0] }
"""


def run(*arguments: object) -> Result:
    """Run a command in this process.

    Args:
        arguments: The command line without the program's name.

    Returns:
        Exit status, stdout and stderr.
    """
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def numbers_of_draws() -> dict[str, object]:
    """The constants that say how much this process draws from the posterior."""
    return {name: getattr(sampler, name) for name in ("SIZE", "POPULATIONS", "SWEEPS", "LAST_SWEEPS")}


def few_draws() -> str:
    """Lines of Python with which a process draws as little from the posterior as this one."""
    lines = [f"sampler.{name} = {value!r}" for name, value in numbers_of_draws().items()]
    return "\n".join(["from calibray.uncertainty import sequential_monte_carlo as sampler", *lines])


def write_wall_study(folder: Path) -> Path:
    """Write the smallest study: one triangle as a wall, three links.

    Args:
        folder: The folder.

    Returns:
        The study file.
    """
    contents = {"study.toml": STUDY, "scene.xml": SCENE, "house.ply": MESH, "links.csv": LINKS}
    for name, text in contents.items():
        (folder / name).write_text(text)
    return folder / "study.toml"


def write_study(folder: Path, content: dict) -> None:
    """Write the content of a study as study.toml.

    Args:
        folder: The folder.
        content: The sections, as `Study.content` returns them.
    """
    sections = dict(content)
    parameters = sections.pop("parameters")
    lines = ["version = 1"]
    for name, section in sections.items():
        if isinstance(section, dict) and section:
            lines += [f"[{name}]", *(f"{key} = {toml(value)}" for key, value in section.items())]
    lines += ["[parameters]", *(f'"{key}" = {toml(value)}' for key, value in parameters.items())]
    (folder / "study.toml").write_text("\n".join(lines))


def toml(value: object) -> str:
    """Format a value as TOML.

    Args:
        value: A number, text, list or table.

    Returns:
        The value on one line.
    """
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(entry)}" for key, entry in value.items()) + " }"
    return json.dumps(value)
