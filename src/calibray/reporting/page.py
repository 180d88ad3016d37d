"""The report of a calibration: a single HTML file that opens from disk and loads no other files.

Names come from files, so they are not trusted. The template engine escapes text, and `<`, `>` and `&` are escaped in
embedded JSON. A content security policy allows only the script with the stated checksum.
"""

from __future__ import annotations

import json
import math
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from calibray.doctor import versions
from calibray.errors import EngineError, InputError
from calibray.reporting import result_tables as tables
from calibray.reporting.figures import result_figures
from calibray.reporting.link_map import Plan, marks, plan, ramp, ramp_limit
from calibray.reporting.link_survey import Survey, in_measured_quantity, measured_quantity, residual, survey
from calibray.reporting.summary import summary
from calibray.reporting.viewer import TRIANGLES, Rays, packed, rays
from calibray.reporting.wording import carriers_text, diagnostics_table, group_text, held_out_text
from calibray.result.held_out import Model
from calibray.result.record import Record, check_record
from calibray.result.verdict import Verdict
from calibray.scenes import Scene, Triangles, read_scene, read_triangles
from calibray.scenes.obstruction import Region
from calibray.study.row_steps import study_regions
from calibray.support import figure_style as style
from calibray.support.messages import command
from calibray.support.output_files import check_file, check_outputs, write_text
from calibray.support.progress import Progress
from calibray.tables import Column, Table, decibels, numbers
from calibray.validation.validation import Validation, observables_table

FILE: Final = "report.html"
FIGURES: Final = "figures"
WORST: Final = 10
"""Maximum number of links in the table of the largest residuals."""

CAPTIONS: Final = {
    "convergence": "RMSE of the best candidate so far versus RT calls (runs of the ray tracer over all links). The "
    "RMSE can increase if the objective is not the RMSE alone.",
    "cumulative-cost": "RT calls and time versus iterations of the method.",
    "path-loss": "Path loss of every link: measured, and modelled before and after calibration.",
    "residual-over-distance": "Residual (predicted minus measured) versus distance between the antennas.",
    "possible-values": "Posterior of every parameter between its bounds. Wide line: 95 % interval. Dashed: value "
    "before calibration. Solid: calibrated value.",
    "held-out-errors": "Cumulative distribution of the absolute errors of held-out links, by model. The best model is "
    "drawn in bold.",
    "held-out-blocks": "RMSE on each held-out block, by model.",
    "power": "Power by material and type of interaction: share of the links' power on paths that interact with the "
    "material. A path contributes to the share of each of its interactions.",
    "neighbours": "Semivariance of the residuals versus distance between links, computed from the positions of both "
    "ends. If the semivariance increases with distance, neighbouring links share part of their errors.",
    "leverage": "Residual versus leverage. A link with a leverage near 1 determines an unknown almost alone, so its "
    "residual contains no information about its error.",
    "residual-by-depth": "Mean residual by the number of interactions of the strongest path, with two standard errors. "
    "The number of links is given in brackets.",
    "observables": "Measured versus modelled values of further observables, link by link, without device biases. "
    "The line marks equal values.",
    "residual-by-direction": "Predicted minus measured path loss around each transmitter, by compass direction: points "
    "outside the black circle received more power than predicted. Orange: the stated horizontal antenna pattern, from "
    "its maximum at the rim to 30 dB below this maximum at the centre.",
    "residual-by-group": "Residual by group: median, quartiles, and whiskers that contain 90 % of the links.",
}

PICTURES: Final = tuple(f"{name}.{suffix}" for name in CAPTIONS for suffix in ("svg", "png"))


@dataclass(frozen=True)
class PageData:
    """The data that a page shows in addition to the result itself.

    Attributes:
        links: The links with their positions; None if the positions are unknown.
        scene: The scene; None if the scene can no longer be read.
        triangles: Meshes of the scene.
        rays: Paths of the links; None if no paths are available.
        missing: Items that are not shown, each with the reason.
        regions: Regions of the study, by name.
    """

    links: Survey | None
    scene: Scene | None = None
    triangles: Triangles | None = None
    rays: Rays | None = None
    missing: tuple[str, ...] = ()
    regions: Mapping[str, Region] = field(default_factory=dict)


def report(
    result: Record,
    file: str | Path = FILE,
    *,
    figures: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write the report of a calibration as one HTML file that opens from disk.

    Args:
        result: The calibration; paths that the calibration does not contain are read from the cache or traced.
        file: File to write; an existing file is replaced only after the new file is complete.
        figures: Folder for the figures as SVG and PNG; a missing folder is created, and figures of an earlier report
            are removed. If None, no separate figure files are written.
        overwrite: If True, also replace files that Calibray did not write.
        progress: Function that is called with the stage "tracing" after every launch of rays.

    Raises:
        InputError: The file's name does not end in .html or .htm, the file or a file in the folder cannot be written,
            or a file in the folder must not be replaced.
    """
    check_record(result)
    inputs = result.study.files()
    target = check_file(file, inputs, overwrite)
    if target.suffix.lower() not in {".html", ".htm"}:
        raise InputError(
            f"output file {target}: the report is an HTML page; choose a name that ends in .html"
        )
    folder = None if figures is None else check_outputs(figures, PICTURES, inputs, overwrite)
    data = collect(result, progress)
    drawn = result_figures(result, data.links)
    try:
        write_text(target, page(result, data, drawn))
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            # The figures are drawn again, because figures within the page have no background.
            for name, figure in result_figures(result, data.links).items():
                for suffix in ("svg", "png"):
                    style.write(figure, folder / f"{name}.{suffix}")
            # Remove figures of an earlier result that this result does not have.
            for picture in PICTURES:
                if Path(picture).stem not in drawn:
                    (folder / picture).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); choose another file") from None
    return target


def collect(result: Record, progress: Progress | None = None) -> PageData:
    """Collect the data that a page needs in addition to the result itself, and list the items that are unavailable."""
    study, missing = result.study, []
    links = survey(result)
    if links is not None and links.group is not None:
        shown = {label: group_text(result, str(label)) for label in set(links.group)}
        links = replace(links, group=np.array([shown[label] for label in links.group], dtype=object))
    if links is None:
        missing.append(f"Positions of the links: {study.links.file} can no longer be read, or has changed.")
    scene = result.scene
    if scene is None:
        try:
            scene = read_scene(study.scene_source, study.scene.frequency, study.overrides, study.objects)
        except InputError as error:
            missing.append(f"Scene: {error}.")
    triangles = None if scene is None else read_triangles(scene)
    regions = {}
    try:
        regions = study_regions(study)
    except InputError as error:
        missing.append(f"Regions: {error}.")
    drawn = None
    if study.engine.external and result.paths is None:
        reason = (
            "are not in the ledger" if study.engine.exports_rays else "are not part of the program's answers"
        )
        missing.append(f"Paths: the paths of the engine {study.engine.name} {reason}.")
    else:
        try:
            drawn = rays(result, progress)
        except (InputError, EngineError) as error:
            missing.append(f"Paths: {error}.")
        if drawn is not None and drawn.paths.num_links != len(result.links):
            drawn = None
            missing.append("Paths: the links of the study have changed since the calibration.")
    return PageData(links, scene, triangles, drawn, tuple(missing), regions)


def page(result: Record, data: PageData, figures: Mapping[str, Figure]) -> str:
    """Render the report as HTML; `figures` contains the figures by name."""
    environment = Environment(
        loader=PackageLoader("calibray.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = _breakable
    script = _asset("viewer.js")
    layout = None if data.links is None else plan(data.links, data.triangles, data.regions.values())
    return environment.get_template("report.html.jinja").render(
        name=_title(result.study.path),
        heading=tables.heading(result),
        sources=(Path(result.study.links.file).name, "/".join(Path(result.study.scene.file).parts[-2:])),
        date=date.today().isoformat(),
        quantity=measured_quantity(result).name,
        css=Markup(_asset("report.css")),
        script=Markup(script),
        checksum=b64encode(sha256(script.encode()).digest()).decode(),
        tiles=_tiles(result),
        sentences=summary(result, None if data.rays is None else data.rays.links_by_material),
        values=tables.values(result),
        offsets=tables.nuisances(result),
        laws=_laws(result),
        figures={name: Markup(style.inline(figure, name)) for name, figure in figures.items()},
        captions=CAPTIONS,
        worst=_worst(result, data.links),
        map=layout,
        regions=", ".join(data.regions),
        marks=None if data.links is None or layout is None else marks(data.links, layout),
        rays=data.rays,
        missing=data.missing,
        triangles=data.triangles,
        most_triangles=TRIANGLES,
        accuracy=tables.accuracy(result),
        observables=(tables.observables(result), observables_table(result.accuracy.observables)),
        validation=None if result.held_out is None else Validation.of(result.held_out).summary(),
        blocks_allowed=result.study.allows_blocks,
        diagnostics=(
            replace(diagnostics_table(result), title=""),
            tables.remarks(result),
            tables.links(result),
            tables.costs(result),
        ),
        study=json.dumps(result.study.content(), indent=2, ensure_ascii=False),
        commands=_commands(result),
        versions=_versions(),
        data=_script_data(result, data, layout),
    )


def _title(study: Path) -> str:
    """Name of a study: the name of its folder if the file is called study.toml, otherwise the name of the file."""
    return (study.resolve().parent.name if study.stem == "study" else "") or study.stem


def _breakable(name: str) -> Markup:
    """Convert a parameter's name to HTML that allows a line break only after the material."""
    material, dot, constant = name.rpartition(".")
    return escape(material) + dot + Markup("<wbr>") + escape(constant)


def _asset(name: str) -> str:
    return (files("calibray.reporting") / "templates" / name).read_text(encoding="utf-8")


def _tiles(result: Record) -> list[tuple[str, str, tuple[str, ...]]]:
    """The key figures at the top of the page: each has a name, a value, and lines that compare it with other models."""
    model, fit = result.prediction.model, result.fit
    judged = result.holdout_rmse_db is not None
    errors = (
        _held_out_errors(result)
        if judged
        else (fit.rmse_db, fit.nuisance_only_rmse_db, fit.log_distance_rmse_db)
    )
    rmse_db, nuisances_only_db, log_distance_db = errors
    rivals = {
        f"initial materials, {tables.nuisances_only(result)}": nuisances_only_db,
        "log-distance model": log_distance_db,
    }
    identified = sum(interval.verdict == Verdict.IDENTIFIED for interval in result.intervals.values())
    tiles = [
        (
            f"RMSE, {'held-out' if judged else 'calibration'} links",
            f"{decibels(rmse_db)} dB",
            (
                str(model.name),
                *(f"{name}: {decibels(value)} dB" for name, value in rivals.items() if value is not None),
            ),
        ),
        ("Links", f"{len(result.links):,}", (held_out_text(result),)),
        ("RT calls", f"{result.rt_calls:,}", (f"at {carriers_text(result)}",)),
    ]
    if result.intervals:
        tiles.append(("Identified parameters", f"{identified} of {len(result.parameters)}", ("see Values",)))
    return tiles


def _held_out_errors(result: Record) -> tuple[float | None, float | None, float | None]:
    """Held-out RMSE for the prediction model, the initial materials with nuisances, and the log-distance model."""
    model, accuracy = result.prediction.model, result.accuracy
    # If the model was chosen on held-out links, `residual_db` is its RMSE on these links.
    own_db = accuracy.holdout_rmse_db if model.name == Model.CALIBRATED else model.residual_db
    return own_db, accuracy.nuisance_only_holdout_rmse_db, accuracy.log_distance_holdout_rmse_db


def _laws(result: Record) -> Table:
    """The coefficients of the power laws of ITU-R P.2040, if any were calibrated."""
    names = ("itu_a", "itu_b", "itu_c", "itu_d")
    rows = tuple(
        (material, *(f"{law[name]:.4g}" if name in law else "-" for name in names))
        for material, law in result.fit.laws.items()
    )
    columns = (Column("Material"), numbers("a"), numbers("b"), numbers("c"), numbers("d"))
    return Table(
        "Frequency dependence: eps_r = a f^b, sigma = c f^d [S/m], f in GHz (ITU-R P.2040)", columns, rows
    )


def _worst(result: Record, links: Survey | None) -> Table:
    """Tabulate the links with the largest residuals."""
    grouped, quantity = links is not None and links.group is not None, measured_quantity(result)
    columns = (
        numbers("Row"),
        *([Column("group")] if grouped else []),
        numbers("measured", quantity.unit),
        numbers("predicted", quantity.unit),
        numbers("residual", "dB"),
        Column("held out"),
        Column("path"),
    )
    residuals = residual(result.links, quantity.sign)
    measured, predicted = (in_measured_quantity(result, name) for name in ("measured", "predicted"))
    order = np.argsort(-np.nan_to_num(np.abs(residuals), nan=-1.0), kind="stable")[:WORST]
    rows, held_out = [], _held_out(result)
    for link in order[np.isfinite(residuals[order])]:
        row = result.links.iloc[int(link)]
        group = [str(links.group[link])] if links is not None and links.group is not None else []
        cells = (f"{measured[link]:.1f}", f"{predicted[link]:.1f}", f"{residuals[link]:+z.1f}")
        rows.append((str(row["row"]), *group, *cells, held_out[link], "yes" if row["has_path"] else "no"))
    return Table("", columns, tuple(rows))


def _held_out(result: Record) -> list[str]:
    """Whether each link was held out: "yes" (always), "in turn" or "no"."""
    blocks = np.zeros(len(result.links), bool) if result.held_out is None else result.held_out.block >= 0
    always = result.links["held_out"].to_numpy(bool)
    return np.select([always, blocks], ["yes", "in turn"], "no").tolist()


def _commands(result: Record) -> str:
    study = result.study
    options = {"method": study.method.name, "seed": study.method.seed, "engine": study.engine.name}
    return "\n".join(
        (
            command(
                "run",
                study.path.name,
                *(f"--{name}={value}" for name, value in options.items()),
                "--out",
                "DIR",
            ),
            "calibray report DIR     # this page again",
            "calibray map DIR --tx X Y Z     # path loss over the whole scene",
            "calibray export DIR -o FOLDER     # the calibrated scene for Sionna RT, and its materials as tables",
        )
    )


def _versions() -> Table:
    names = ("python", "calibray", "sionna-rt", "mitsuba", "drjit", "jax", "numpy", "scipy")
    installed = dict(versions())
    rows = tuple((name, installed[name]) for name in names if name in installed)
    return Table("", (Column(), Column()), rows)


def _script_data(result: Record, data: PageData, layout: Plan | None) -> dict[str, Any] | None:
    """Data for the page's script; None if the positions of the links are unknown."""
    links = data.links
    if links is None or layout is None:
        return None
    # Each link stores the index of its group instead of the name, which saves space.
    names = [] if links.group is None else sorted(set(links.group.tolist()))
    index = {name: number for number, name in enumerate(names)}
    materials = [] if data.scene is None else list(data.scene.materials)
    residuals, quantity = links.residual_db, measured_quantity(result)
    return {
        "links": {
            "row": links.table["row"].tolist(),
            "group": [] if links.group is None else [index[name] for name in links.group],
            **{
                name: _rounded(in_measured_quantity(result, name))
                for name in ("measured", "before", "predicted")
            },
            "held": links.table["held_out"].astype(int).tolist(),
            "held_out": _held_out(result),
            "lost": (~links.has_path).astype(int).tolist(),
            "faint": links.faint.astype(int).tolist(),
            "color": ramp(residuals, ramp_limit(residuals)),
        },
        "groups": names,
        "quantity": quantity._asdict(),
        "materials": materials,
        "map": {"west": layout.west, "north": layout.north, "scale": layout.scale},
        "solid": packed(links, data.triangles, data.rays, materials),
    }


def _rounded(values: np.ndarray) -> list[float | None]:
    """Round values to 0.01 dB; None replaces infinity and NaN, which JSON cannot express."""
    return [round(value, 2) if math.isfinite(value) else None for value in values.tolist()]
