"""The report: one HTML file that opens from disk, loads nothing, and shows names from files as text only.

Texts are escaped by the template engine, data are embedded as JSON whose `<`, `>` and `&` are written as escapes, and a
content security policy lets no script run but the page's own, which is named by its checksum.
"""

from __future__ import annotations

import json
import math
import shlex
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from calibray import doctor as diagnosis
from calibray.errors import EngineError, InputError
from calibray.reporting import figures as drawings
from calibray.reporting import result_tables as tables
from calibray.reporting.diagnostics import remarkable
from calibray.reporting.link_map import RAMP, WIDTH, Plan, plan, ramp, ramp_limit
from calibray.reporting.link_survey import Survey, residual, survey
from calibray.reporting.rays import Rays
from calibray.reporting.scene_mesh import packed
from calibray.reporting.value_list import values
from calibray.reporting.wording import summary
from calibray.result.record import Record
from calibray.scenes import Scene, Triangles, read_scene, read_triangles
from calibray.support import figure_style as style
from calibray.support.output_files import check_file, check_outputs, write_text
from calibray.support.progress import Progress
from calibray.tables import Column, Table, numbers
from calibray.tables.display import hertz
from calibray.validation.validation import Validation

FILE: Final = "report.html"
FIGURES: Final = "figures"
WORST: Final = 10
"""Links that are listed because most is left of their path loss."""

ALONE: Final = 400
"""Links up to which the map draws every one with its own outline."""

CAPTIONS: Final = {
    "convergence": "Best RMSE after so many runs of the ray tracer over all links (RT calls).",
    "cumulative-cost": "RT calls and time spent, over the method's iterations.",
    "path-loss": "Path loss of every link: measured, before calibration and after; shaded where held out.",
    "residual-over-distance": "Calibrated minus measured path loss over the distance between the antennas.",
    "possible-values": "Draws of every parameter that explain the links, over its bounds: bars where they lie, wide "
    "lines for the 95 % interval, dashes for the value before, a line for the calibrated one.",
    "held-out-errors": "Share of the links held out whose error is within so many dB, by model; the best model bold.",
    "held-out-blocks": "RMSE on each block that was held out, by model.",
    "power": "What the links' power passes by: share of it on paths that meet a material, by kind of interaction. What "
    "a path meets counts in full.",
    "neighbours": "Half the mean square difference of residuals over the distance between links, both ends counted: "
    "where it rises, neighbours share their errors.",
    "leverage": "Residuals over leverage: near 1 a link decides something alone, and its residual tells nothing.",
    "residual-by-depth": "Mean residual by interactions of the strongest path, with two standard errors; links in "
    "brackets.",
    "residual-by-group": "The same by group: median, quartiles, and whiskers around 90 % of the links.",
}

PICTURES: Final = tuple(f"{name}.{suffix}" for name in CAPTIONS for suffix in ("svg", "png"))


@dataclass(frozen=True)
class Shown:
    """What a page is made of, beside the result.

    Attributes:
        links: Where the links stand; None where that is not known.
        scene: The scene; None where it cannot be read any more.
        triangles: Its meshes.
        rays: Paths of the links; None where there are none.
        missing: Why something is not shown.
    """

    links: Survey | None
    scene: Scene | None = None
    triangles: Triangles | None = None
    rays: Rays | None = None
    missing: tuple[str, ...] = ()


def report(
    result: Record,
    file: str | Path = FILE,
    *,
    figures: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write a calibration as one HTML file that opens from disk, for people to look at.

    Args:
        result: The calibration. Paths that it does not hold are taken from the cache, or else traced.
        file: File to write; replaced only once the new one is complete.
        figures: Folder to write the figures into as well, each as SVG and as PNG; made if absent.
        overwrite: Replace files that Calibray did not write.
        progress: Called with the stage "tracing" after every launch.

    Returns:
        The file.

    Raises:
        InputError: The file or the folder cannot be written, or a file there must not be replaced.
    """
    inputs = result.study.files()
    target = check_file(file, inputs, overwrite)
    folder = None if figures is None else check_outputs(figures, PICTURES, inputs, overwrite)
    shown = gather(result, progress)
    drawn = drawings.every(result, shown.links)
    try:
        write_text(target, page(result, shown, drawn))
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for name, figure in drawings.every(result, shown.links).items():
                for suffix in ("svg", "png"):
                    style.write(figure, folder / f"{name}.{suffix}")
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); name another file") from None
    return target


def gather(result: Record, progress: Progress | None = None) -> Shown:
    """Find what a page shows beside the result; what is not to be had is said, not refused.

    Args:
        result: The calibration.
        progress: Called with the stage "tracing" after every launch.

    Returns:
        What was found.
    """
    study, missing = result.study, []
    links = survey(result)
    if links is None:
        missing.append(f"The links' positions: {study.links.file} cannot be read any more.")
    scene = result.scene
    if scene is None:
        try:
            scene = read_scene(study.scene_source, study.scene.frequency, study.overrides, study.objects)
        except InputError as error:
            missing.append(f"The scene: {error}.")
    triangles = None if scene is None else read_triangles(scene)
    found = None
    if study.engine.external:
        missing.append(f"The paths: the engine {study.engine.name} answers path loss, not paths.")
    else:
        from calibray.reporting.rays import rays

        try:
            found = rays(result, progress)
        except (InputError, EngineError) as error:
            missing.append(f"The paths: {error}.")
        if found is not None and found.paths.num_links != len(result.links):
            found = None
            missing.append("The paths: the study's links are no longer those calibrated on.")
    return Shown(links, scene, triangles, found, tuple(missing))


def page(result: Record, shown: Shown, figures: Mapping[str, Figure]) -> str:
    """The report as text.

    Args:
        result: The calibration.
        shown: What it is made of beside.
        figures: Figures by name.

    Returns:
        HTML.
    """
    environment = Environment(
        loader=PackageLoader("calibray.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = _asset("viewer.js")
    layout = None if shown.links is None else plan(shown.links, shown.triangles)
    return environment.get_template("report.html.jinja").render(
        name=result.study.path.stem,
        heading=tables.heading(result),
        css=Markup(_asset("report.css")),
        script=Markup(script),
        checksum=b64encode(sha256(script.encode()).digest()).decode(),
        tiles=_tiles(result),
        sentences=summary(result, None if shown.rays is None else shown.rays.meets),
        values=values(result),
        offsets=tables.offsets(result),
        laws=_laws(result),
        figures={name: Markup(style.inline(figure, name)) for name, figure in figures.items()},
        captions=CAPTIONS,
        worst=_worst(result, shown.links),
        map=layout,
        marks=None if shown.links is None or layout is None else _marks(shown.links, layout),
        rays=shown.rays,
        missing=shown.missing,
        triangles=shown.triangles,
        accuracy=tables.accuracy(result),
        validation=None if result.held_out is None else Validation.of(result.held_out).summary(),
        diagnostics=(
            replace(remarkable(result), title=""),
            tables.remarks(result),
            tables.links(result),
            tables.costs(result),
        ),
        study=json.dumps(result.study.content(), indent=2, ensure_ascii=False),
        commands=_commands(result),
        versions=_versions(),
        data=_data(result, shown, layout),
    )


def _asset(name: str) -> str:
    return (files("calibray.reporting") / "templates" / name).read_text(encoding="utf-8")


def _tiles(result: Record) -> list[tuple[str, str, str]]:
    """The figures that are asked for first: heading, value, and what to compare it with."""
    judged = result.holdout_rmse_db is not None
    after = result.holdout_rmse_db if judged else result.rmse_db
    before = result.accuracy.initial_holdout_rmse_db if judged else result.initial_rmse_db
    rival = result.accuracy.log_distance_holdout_rmse_db if judged else result.fit.log_distance_rmse_db
    told = sum(interval.verdict == "identified" for interval in result.intervals.values())
    where = "held out" if judged else "calibrated on"
    tiles = [
        (
            f"RMSE, links {where}",
            f"{after:.2f} dB",
            f"before {before:.2f} dB, log-distance model {rival:.2f} dB",
        ),
        ("Links", f"{len(result.links):,}", f"{result.counts['held_out']:,} of them held out"),
        ("RT calls", f"{result.rt_calls:,}", f"at {hertz(result.study.scene.frequency)}"),
    ]
    if result.intervals:
        tiles.append(("Values identified", f"{told} of {len(result.parameters)}", "by their verdicts"))
    return tiles


def _laws(result: Record) -> Table:
    """The coefficients of ITU-R P.2040's law, where they were calibrated."""
    names = ("itu_a", "itu_b", "itu_c", "itu_d")
    rows = tuple(
        (material, *(f"{law[name]:.4g}" for name in names)) for material, law in result.fit.laws.items()
    )
    columns = (Column("Material"), numbers("a"), numbers("b"), numbers("c"), numbers("d"))
    return Table("Over frequency: eps_r = a f^b, sigma = c f^d [S/m], f in GHz (ITU-R P.2040)", columns, rows)


def _worst(result: Record, links: Survey | None) -> Table:
    """The links of whose path loss most is left."""
    columns = (
        numbers("Row"),
        *([Column("group")] if links is not None and links.group is not None else []),
        numbers("measured", "dB"),
        numbers("calibrated", "dB"),
        numbers("difference", "dB"),
        Column("held out"),
    )
    left = residual(result.links)
    order = np.argsort(-np.nan_to_num(np.abs(left), nan=-1.0), kind="stable")[:WORST]
    rows = []
    for place in order[np.isfinite(left[order])]:
        row = result.links.iloc[int(place)]
        group = [str(links.group[place])] if links is not None and links.group is not None else []
        values = (f"{row['measured_db']:.1f}", f"{row['after_db']:.1f}", f"{left[place]:+.1f}")
        rows.append((str(row["row"]), *group, *values, "yes" if row["held_out"] else "no"))
    return Table("", columns, tuple(rows))


def _marks(links: Survey, layout: Plan) -> dict[str, Any]:
    """What the map shows of links: the end that moves as discs, the other as masts."""
    left = links.residual_db
    limit = ramp_limit(left)
    by_rx = len(np.unique(links.rx, axis=0)) >= len(np.unique(links.tx, axis=0))
    moving, standing = (links.rx, links.tx) if by_rx else (links.tx, links.rx)
    radius = 6.5 if len(left) <= ALONE else 4.0 if len(left) <= 10 * ALONE else 2.5
    at = layout.place(moving).round(1).tolist()
    return {
        "width": WIDTH,
        "radius": radius,
        "limit": f"{limit:g}",
        "ramp": ", ".join(RAMP),
        "ends": ("receivers", "transmitters") if by_rx else ("transmitters", "receivers"),
        # The largest last, in sight.
        "links": [
            (*at[k], color, bool(held))
            for k, color, held in sorted(
                zip(range(len(left)), ramp(left, limit), links.table["held_out"], strict=True),
                key=lambda each: -1.0 if math.isnan(left[each[0]]) else abs(left[each[0]]),
            )
        ],
        "masts": np.unique(layout.place(standing).round(1), axis=0).tolist(),
        "bar": layout.bar * layout.scale,
    }


def _commands(result: Record) -> str:
    study = result.study
    options = {"method": study.method.name, "seed": study.method.seed, "engine": study.engine.name}
    words = [
        "calibray", "run", study.path.name, *(f"--{name}={value}" for name, value in options.items()), "--out", "DIR",
    ]  # fmt: skip
    return "\n".join(
        (
            " ".join(map(shlex.quote, words)),
            "calibray report DIR     # this page again",
            "calibray map DIR --tx X Y Z     # path loss over the whole scene",
            "calibray export DIR -o FOLDER     # the calibrated scene for Sionna RT, and its materials as tables",
        )
    )


def _versions() -> Table:
    wanted = ("python", "calibray", "sionna-rt", "mitsuba", "drjit", "jax", "numpy", "scipy")
    known = dict(diagnosis.versions())
    return Table("", (Column(), Column()), tuple((name, known[name]) for name in wanted if name in known))


def _data(result: Record, shown: Shown, layout: Plan | None) -> dict[str, Any] | None:
    """What the page's script shows; None where the links' positions are not known."""
    links = shown.links
    if links is None or layout is None:
        return None
    names = [] if links.group is None else sorted(set(links.group.tolist()))
    index = {name: place for place, name in enumerate(names)}
    materials = [] if shown.scene is None else list(shown.scene.materials)
    left = links.residual_db
    return {
        "links": {
            "row": links.table["row"].tolist(),
            "group": [] if links.group is None else [index[name] for name in links.group],
            **{
                name: _tenths(links.table[f"{name}_db"].to_numpy(float))
                for name in ("measured", "before", "after")
            },
            "held": links.table["held_out"].astype(int).tolist(),
            "color": ramp(left, ramp_limit(left)),
        },
        "groups": names,
        "materials": materials,
        "map": {"west": layout.west, "north": layout.north, "scale": layout.scale},
        "solid": packed(links, shown.triangles, shown.rays, materials),
    }


def _tenths(column: np.ndarray) -> list[float | None]:
    """Values to 0.01 dB; None for what is no number, which JSON does not know."""
    return [round(value, 2) if math.isfinite(value) else None for value in column.tolist()]
