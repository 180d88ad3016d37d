"""The study: one calibration problem, read from its file."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, ValidationError, field_validator, model_validator

from calibray.engines.kinds import AnyEngine, default
from calibray.errors import InputError
from calibray.materials import DEFAULT_REVISION, ItuLaw, Material, itu_material
from calibray.measurements import (
    LINK_COLUMNS,
    Measurements,
    SourceTable,
    links_from_table,
    measured_links,
    read_table,
)
from calibray.parameters import LogNormal, Parameter, Parameters, itu_start, make_parameter
from calibray.parameters.laws import frequency_independent_law
from calibray.study.engine_keys import part_engine
from calibray.study.row_steps import link_columns, placing, preparation
from calibray.study.sections import (
    AntennasSection,
    FidelitySection,
    HoldoutSection,
    LinksSection,
    MaterialSection,
    MethodSection,
    NoiseSection,
    NuisanceSection,
    ObjectiveSection,
    OffsetSection,
    ParameterSection,
    SceneSection,
    TraceSection,
)
from calibray.study.summary import summary
from calibray.study.toml_file import expand, read_content, refuse_unquoted_names
from calibray.study.validation_errors import dotted, explain
from calibray.support.messages import shortened
from calibray.support.output_files import exists
from calibray.support.strict_models import Section, Text
from calibray.tables import display as glance
from calibray.tracing.settings import Antenna

if TYPE_CHECKING:
    from calibray.study.setup import Setup

VERSION: Final = 1
"""The version of the study file that this module reads."""

LATER: Final = ("nuisance", "noise")
"""Sections that version 1 did not have at first; without content they are not written."""

BUNDLED: Final = "sionna:"
"""What the name of a scene bundled with Sionna RT begins with."""


class Study(Section):
    """One calibration problem, as its study file states it; see ``docs/study-file.md``.

    Attributes:
        version: Version of the file's format.
        scene: The scene and the carrier.
        objects: Materials to be made for some objects, by name: a pattern of the objects' names.
        materials: Constants in place of the scene's, by material name.
        links: The measured links.
        antennas: The antennas.
        trace: The tracer's switches.
        objective: How paths become a path loss.
        parameters: The free parameters by name, in the order of a candidate's components.
        offset: The nuisance offset, or None.
        nuisance: Further columns of the nuisance by name.
        noise: The errors of measured links.
        holdout: The links held out, or None.
        fidelity: When to trace again.
        method: The optimizer.
        engine: The engine.
    """

    version: int
    scene: SceneSection
    objects: dict[str, Text] = Field(default_factory=dict)
    materials: dict[str, MaterialSection] = Field(default_factory=dict)
    links: LinksSection
    antennas: AntennasSection = Field(default_factory=AntennasSection)
    trace: TraceSection = Field(default_factory=TraceSection)  # type: ignore[valid-type]
    objective: ObjectiveSection = Field(default_factory=ObjectiveSection)
    parameters: dict[str, ParameterSection]
    offset: OffsetSection | None = None
    nuisance: dict[str, NuisanceSection] = Field(default_factory=dict)
    noise: NoiseSection = Field(default_factory=NoiseSection)
    holdout: HoldoutSection | None = None
    fidelity: FidelitySection = Field(default_factory=FidelitySection)
    method: MethodSection = Field(default_factory=MethodSection)
    engine: AnyEngine = Field(default_factory=default)

    _path: Path = PrivateAttr(default=Path("study.toml"))
    _other_engines: dict[str, Any] = PrivateAttr(default_factory=dict)

    @field_validator("version")
    @classmethod
    def _known_version(cls, value: int) -> int:
        if value != VERSION:
            raise InputError(
                f"this Calibray reads version {VERSION}; convert the file, or install a Calibray that fits"
            )
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.objective.combining == "band" and self.scene.bandwidth is None:
            raise InputError("objective.combining = 'band' needs scene.bandwidth [Hz]")
        if self.links.quantity == "rsrp" and self.offset is None:
            raise InputError(
                "links.quantity = 'rsrp' needs [offset]: what was transmitted is not known, and the offset takes it"
            )
        if self.links.below_floor == "censor" and self.noise.range_m not in ("auto", 0):
            raise InputError(
                f"links.below_floor = 'censor' with noise.range_m = {self.noise.range_m:g}: censored links are "
                "counted as if their errors were independent; leave one of them out"
            )
        frequency = self.scene.frequency
        for name, material in self.materials.items():
            if material.itu is not None:
                try:
                    itu_material(material.itu, frequency, revision=material.revision or DEFAULT_REVISION)
                except InputError as error:
                    raise InputError(f"{dotted(('materials', name))}: {error}") from None
        # What the scene alone could tell is checked by `parameter_set`; all else before anything is traced.
        names = []
        for name, entry in self.parameters.items():
            start = itu_start(name, entry.start, frequency) if isinstance(entry.start, str) else entry.start
            lower, upper = entry.bounds
            names.append(Parameter(name, lower, upper, lower if start is None else start, entry.scale))
            if entry.prior is not None:
                entry.centre(name, frequency)
        Parameters(tuple(names))
        if "offset" in self.nuisance:
            raise InputError("nuisance.offset: [offset] has this name; choose another")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Study:
        """Read a study file.

        Args:
            path: The TOML file.

        Returns:
            The study.

        Raises:
            InputError: The file does not exist, is no TOML, has an unknown key or an impossible value, or
                names a scene or links that do not exist; one line for each fault.
        """
        path = Path(path)
        content = read_content(path)
        study = cls.from_content(content, path)
        study._check_files()
        return study

    @classmethod
    def from_content(cls, content: Mapping[str, Any], path: str | Path = "study.toml") -> Study:
        """A study from the content of a study file; that its files exist is not checked.

        Args:
            content: Sections by name, as TOML gives them.
            path: Where the study file stands or would stand; other files are relative to its folder.

        Returns:
            The study.

        Raises:
            InputError: A key is unknown or a value impossible; one line for each fault.
        """
        refuse_unquoted_names(content.get("parameters"), path)
        own, others = part_engine(content.get("engine", {}), str(path))
        content = {**content, "engine": own}
        try:
            # By way of JSON, where lists pass for tuples and yet nothing is converted: "4" is no number.
            text = json.dumps(content, default=str)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: a value cannot be used ({error}); correct it") from None
        try:
            study = cls.model_validate_json(text)
        except ValidationError as error:
            refusal = explain(error, cls, content, str(path), tagged=("engine",))
            raise refusal from None
        study._path, study._other_engines = Path(path), others
        return study

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).from_content, (self.content(), self._path.absolute())

    def __repr__(self) -> str:
        return glance.text(*summary(self))

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return glance.html(*summary(self))

    @property
    def path(self) -> Path:
        """The study file."""
        return self._path

    @property
    def scene_source(self) -> str:
        """The scene: the path of its file, or "sionna:NAME"."""
        return (
            self.scene.file
            if self.scene.file.startswith(BUNDLED)
            else str(self._resolve("scene.file", self.scene.file))
        )

    @property
    def links_path(self) -> Path:
        """The table of links."""
        return self._resolve("links.file", self.links.file)

    @property
    def transmitters_path(self) -> Path | None:
        """The table of transmitters, if there is one."""
        file = self.links.transmitters
        return None if file is None else self._resolve("links.transmitters", file)

    @property
    def track_path(self) -> Path | None:
        """The track, if there is one."""
        track = self.links.track
        return None if track is None else self._resolve("links.track.file", track.file)

    @property
    def antenna_pair(self) -> tuple[Antenna, Antenna]:
        """The transmit and the receive antenna, their files of gains resolved."""
        ends = ((end, getattr(self.antennas, end)) for end in ("tx", "rx"))
        tx, rx = (
            antenna
            if antenna.gain_file is None
            else Antenna(
                str(self._resolve(f"antennas.{end}.pattern", antenna.pattern).resolve()),
                antenna.polarization,
                antenna.orientation,
            )
            for end, antenna in ends
        )
        return tx, rx

    @property
    def overrides(self) -> dict[str, dict[str, Any]]:
        """The constants of ``[materials]`` by material name; only those that are given."""
        return {name: material.model_dump(exclude_none=True) for name, material in self.materials.items()}

    def measurements(self) -> Measurements:
        """Read the links, grouped as the offset is.

        Returns:
            All links of the study, those held out included.

        Raises:
            InputError: What `measured_links` refuses, or nothing tells where the scene lies on the globe.
        """
        return measured_links(read_table(self.links_path), link_columns(self), preparation(self))

    def places(self, table: SourceTable) -> Measurements:
        """Links without measured values, to predict at, grouped as the offset is.

        Args:
            table: Rows with the columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m] in the scene's frame; without these,
                with the columns that ``[links]`` names for positions, which mean what they mean there. No row is
                left out.

        Returns:
            A link for every row, with carriers if the table has the study's column of them.

        Raises:
            InputError: A column is missing or malformed, or a position is not finite.
        """
        group, links = self.offset.per if self.offset else None, self.links
        given, own = {*table.frame}, {*links.tx, *links.rx}
        if given >= {*LINK_COLUMNS} or not given & own:
            return links_from_table(table, group, links.frequency)
        return links_from_table(table, group, links.frequency, steps=placing(self), tx=links.tx, rx=links.rx)

    def held_out(self, measurements: Measurements) -> NDArray[np.bool_]:
        """Which links are held out; none without ``[holdout]``, or where each block is in turn.

        Args:
            measurements: Links with the columns that the hold-out's filter names.

        Returns:
            The mask [links].

        Raises:
            InputError: The filter is not valid, or one of the parts would be empty.
        """
        if self.holdout is None or self.holdout.where is None:
            return np.zeros(len(measurements), dtype=bool)
        return measurements.held_out(self.holdout.where)

    def opened(self) -> Setup:
        """The study opened: its links, scene and parameters read (see `Setup.open`)."""
        from calibray.study.setup import Setup

        return Setup.open(self)

    @property
    def priors(self) -> LogNormal:
        """What is known of the parameters beforehand, by their places in a candidate."""
        entries = enumerate(self.parameters.items())
        known = [(k, name, entry, entry.prior) for k, (name, entry) in entries if entry.prior is not None]
        return LogNormal(
            tuple(k for k, *_ in known),
            tuple(entry.centre(name, self.scene.frequency) for _, name, entry, _ in known),
            tuple(prior.spread for *_, prior in known),
        )

    def parameter_set(
        self, base: Mapping[str, Material], laws: Mapping[str, ItuLaw] | None = None
    ) -> Parameters:
        """The free parameters of a scene, their starts resolved.

        Args:
            base: The scene's materials by name, those of ``[materials]`` replaced.
            laws: How their constants follow the frequency; those not named do not.

        Returns:
            The parameters, in the order of the file.

        Raises:
            InputError: The scene lacks a parameter's material, or a start lies outside its bounds.
        """
        frequency = self.scene.frequency
        try:
            items = tuple(
                make_parameter(name, entry.bounds, base, frequency, entry.start, entry.scale, laws)
                for name, entry in self.parameters.items()
            )
            known = {name: frequency_independent_law(material) for name, material in base.items()} | dict(
                laws or {}
            )
            lawful = {item.material: known[item.material] for item in items if item.field != item.constant}
            parameters = Parameters(items, frequency, lawful)
            parameters.check_carriers([frequency])
        except InputError as error:
            raise InputError(f"{self._path}: {error}") from None
        return parameters

    def replace(self, method: str | None = None, seed: int | None = None, engine: str | None = None) -> Study:
        """The study with another method, seed or engine; the options of a method that is replaced go with it.

        Args:
            method: Name of the method, or None to keep it.
            seed: Seed, or None to keep it.
            engine: Name of the engine, or None to keep it.

        Returns:
            The changed study.

        Raises:
            InputError: A value is impossible.
        """
        content = self.content()
        if method is not None and method != self.method.name:
            content["method"] = {"name": method, "seed": self.method.seed, "model": self.method.model}
        if seed is not None:
            content["method"]["seed"] = seed
        if engine is not None:
            content["engine"]["name"] = engine
        return Study.from_content(content, self._path)

    def content(self) -> dict[str, Any]:
        """The study as plain values, every default written out; `from_content` takes it back."""
        content = self.model_dump(mode="json", exclude_none=True)
        for name in LATER:
            # Studies without them keep the fingerprint that they always had.
            if not content[name]:
                del content[name]
        if self.method.model == MethodSection().model:
            del content["method"]["model"]
        content["engine"] |= self._other_engines
        return content

    def digest(self) -> str:
        """A fingerprint of the study: SHA-256 of its content, the same however the file is laid out.

        The order of the parameters counts, since it orders a candidate's components; the files named do not.
        """
        content = self.content() | {"parameters": list(self.content()["parameters"].items())}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def files(self) -> tuple[Path, ...]:
        """The files that the study names, and its own; those of a bundled scene are left out."""
        antennas = [Path(each.gain_file) for each in self.antenna_pair if each.gain_file is not None]
        scene = [] if self.scene.file.startswith(BUNDLED) else [Path(self.scene_source)]
        others = [path for path in (self.transmitters_path, self.track_path) if path is not None]
        return (self._path, self.links_path, *others, *scene, *antennas)

    def _resolve(self, key: str, file: str) -> Path:
        try:
            return self._path.parent / expand(file, os.environ)
        except InputError as error:
            raise InputError(f"{self._path}: {key} = {file!r}: {error}") from None

    def _check_files(self) -> None:
        files: list[tuple[str, str, str | Path]] = [
            ("scene.file", self.scene.file, self.scene_source),
            ("links.file", self.links.file, self.links_path),
        ]
        if self.links.transmitters is not None and self.transmitters_path is not None:
            files.append(("links.transmitters", self.links.transmitters, self.transmitters_path))
        if self.links.track is not None and self.track_path is not None:
            files.append(("links.track.file", self.links.track.file, self.track_path))
        for end, antenna in zip(("tx", "rx"), self.antenna_pair, strict=True):
            if antenna.gain_file is not None:
                written = getattr(self.antennas, end).pattern
                files.append((f"antennas.{end}.pattern", written, antenna.gain_file))
        for key, written, file in files:
            if not str(file).startswith(BUNDLED) and not exists(file):
                raise InputError(
                    f"{self._path}: {key} = {shortened(written)!r}: no such file, "
                    f"{shortened(str(Path(file).absolute()), 300)}"
                )
