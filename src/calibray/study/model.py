"""The closed model of a study file: its sections, their validation, and the files that they name."""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final, Self

from pydantic import Field, PrivateAttr, field_validator, model_validator

from calibray.engines.kinds import AnyEngine, default
from calibray.engines.kinds.replay import ReplaySection
from calibray.errors import InputError
from calibray.materials import DEFAULT_REVISION, ItuLaw, Material, itu_material
from calibray.parameters import (
    LogNormal,
    Parameter,
    Parameters,
    is_effect,
    itu_start,
    make_parameter,
    split_name,
)
from calibray.parameters.laws import ROUGHNESS, frequency_independent_law
from calibray.parameters.parameter import check_material
from calibray.study.displacement import RECEIVER, displaces
from calibray.study.facades import FacadeSection
from calibray.study.link_obstruction import CLUTTER, REGION
from calibray.study.link_obstruction import COLUMNS as OBSTRUCTION
from calibray.study.observables import ObservableSection, by_column
from calibray.study.regions import PREFIX, RegionSection
from calibray.study.sections import (
    AntennasSection,
    FidelitySection,
    HoldoutSection,
    LinksSection,
    MaterialSection,
    MethodSection,
    NoiseSection,
    NuisanceSection,
    NuisanceTerm,
    ObjectiveSection,
    OffsetSection,
    ParameterSection,
    SceneSection,
    TraceSection,
)
from calibray.study.toml_file import expand
from calibray.study.validation_errors import dotted
from calibray.support.messages import did_you_mean, shortened
from calibray.support.output_files import exists
from calibray.support.strict_models import Section, Text
from calibray.tracing.mounting import EVERY, POSE, turns
from calibray.tracing.settings import Antenna

VERSION: Final = 1
"""The version of the study file that this module reads."""

BUNDLED: Final = "sionna:"
"""Prefix of the name of a scene bundled with Sionna RT."""

OFFSET: Final = "offset"
"""Name of the nuisance term that ``[offset]`` is the short form of."""


class StudyModel(Section, ABC):
    """The content of a study file; `calibray.Study` is the class to use."""

    version: int
    scene: SceneSection
    objects: dict[str, Text] = Field(default_factory=dict)
    materials: dict[str, MaterialSection] = Field(default_factory=dict)
    facades: dict[str, FacadeSection] = Field(default_factory=dict)
    links: LinksSection
    antennas: AntennasSection = Field(default_factory=AntennasSection)
    trace: TraceSection = Field(default_factory=TraceSection)  # type: ignore[valid-type]
    objective: ObjectiveSection = Field(default_factory=ObjectiveSection)
    parameters: dict[str, ParameterSection]
    observables: dict[str, ObservableSection] = Field(default_factory=dict)
    regions: dict[str, RegionSection] = Field(default_factory=dict)
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
                f"this Calibray reads version {VERSION}; convert the file, or install a Calibray that reads it"
            )
        return value

    @field_validator("observables")
    @classmethod
    def _one_per_column(cls, value: dict[str, ObservableSection]) -> dict[str, ObservableSection]:
        return by_column(value)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.objective.combining == "band" and self.scene.bandwidth is None:
            raise InputError("objective.combining = 'band' needs scene.bandwidth [Hz]")
        if self.links.quantity == "rsrp" and self.offset is None:
            raise InputError(
                "links.quantity = 'rsrp' needs [offset]: the transmitted power is unknown, and is part of the offset"
            )
        if self.links.below_floor == "censor" and self.noise.range_m not in ("auto", 0):
            raise InputError(
                f"links.below_floor = 'censor' with noise.range_m = {self.noise.range_m:g}: censored links are "
                "counted as if their errors were independent; leave one of them out"
            )
        self._check_rays()
        self._check_observables()
        self._check_losses()
        self._check_poses()
        self._check_position_errors()
        if OFFSET in self.nuisance:
            raise InputError("nuisance.offset: [offset] has this name; choose another")
        if getattr(self.engine, "rays", None) and (
            self.links.mountings or self.links.position_error_m is not None
        ):
            raise InputError(
                "engine.rays holds paths of one position and one antenna: leave links.tx_antenna, rx_antenna and "
                "position_error_m out"
            )
        if self.links.mountings and self.engine.name != "replay":
            end = next(iter(self.links.mountings))
            raise InputError(
                f"links.{end}_antenna with engine.name = {self.engine.name!r}: antennas that differ between links are "
                "applied to stored paths; use engine 'replay'"
            )
        self._check_materials()
        self._check_parameters()
        return self

    def _check_rays(self) -> None:
        refused = {
            f"objective.combining = {self.objective.combining!r}": self.objective.combining != "power",
            "links.frequency": self.links.frequency is not None,
            "[observables]": bool(self.observables),
            "coefficients of laws": any(".itu_" in name for name in self.parameters),
        }
        for key, stated in refused.items():
            if self.engine.exports_rays and stated:
                raise InputError(
                    "engine.rays = true: powers of rays are compared at one carrier and add up, so it does not go with "
                    f"{key}; remove one of them"
                )

    def _check_observables(self) -> None:
        if not self.observables:
            return
        if getattr(self.engine, "compress_db", None) is not None:
            raise InputError(
                "engine.compress_db: few weighted paths keep path loss, not the delays and angles of [observables]; "
                "remove one of them"
            )
        if self.links.average is not None and any(each.file is None for each in self.observables.values()):
            raise InputError(
                "links.average with [observables]: averages keep the columns of the first sample; average the table "
                "itself, or remove one of them"
            )
        if self.engine.name == "retrace":
            raise InputError("[observables] with engine.name = 'retrace': use 'replay' or 'command'")
        unstated = [name for name, section in self.observables.items() if section.std is None]
        if self.engine.expensive and (unstated or (self.links.std is None and self.noise.std_db is None)):
            missing = f"observables.{unstated[0]}.std" if unstated else "noise.std_db"
            raise InputError(
                f"{missing}: is required, because observables are weighted by their errors, and the engine "
                f"{self.engine.name!r} has too few calls to estimate them"
            )

    def _check_losses(self) -> None:
        for name in self.parameters:
            region = name.removeprefix(PREFIX).rpartition(".")[0]
            if name.startswith(PREFIX) and region not in self.regions:
                raise InputError(
                    f"parameters: {name!r}: no [regions.{region}]; {did_you_mean(region, self.regions)}"
                )
        if self.facades and getattr(self.engine, "rays", None):
            raise InputError("engine.rays: rays of a table have no walls; remove [facades]")
        for name, section in self.nuisance.items():
            if section.by == REGION and not self.regions:
                raise InputError(
                    f"nuisance.{name}.by = {REGION!r}: there are no [regions] that lines could cross"
                )
        rough = [name for name in self.parameters if name.endswith(f".{ROUGHNESS}")]
        rough += [f"materials.{name}.{ROUGHNESS}" for name in self.roughness_mm]
        stated = (("[regions]", self.regions), ("[facades]", self.facades), ("".join(rough[:1]), rough))
        for key, used in stated:
            if used and self.engine.name != "replay":
                raise InputError(
                    f"{key} needs engine.name = 'replay'; the engine {self.engine.name!r} has no paths"
                )
            if used and getattr(self.engine, "compress_db", None) is not None:
                raise InputError(
                    f"engine.compress_db: few weighted paths do not go with {key}; remove one of them"
                )

    def _check_position_errors(self) -> None:
        links = self.links
        if links.position_error_m is None:
            return
        refused = {
            "links.weight": links.weight is not None,
            "links.frequency": links.frequency is not None,
            f"objective.combining = {self.objective.combining!r}": self.objective.combining != "power",
            f"engine.name = {self.engine.name!r}": self.engine.name != "replay",
        }
        for key, stated in refused.items():
            if stated:
                raise InputError(
                    f"links.position_error_m: powers at displaced receivers are averaged on replay, at one carrier; it "
                    f"does not go with {key}"
                )
        if links.std is None and self.noise.std_db is None:
            raise InputError(
                "links.position_error_m adds to the other errors of a link: give links.std or noise.std_db [dB]"
            )

    def _check_poses(self) -> None:
        self._check_displacements()
        names = [name for name in self.parameters if turns(name)]
        if names and self.links.tx_antenna is None:
            raise InputError(
                f"parameters: {names[0]!r} needs [links.tx_antenna], the stated directions of the transmit antennas"
            )
        if names and getattr(self.engine, "compress_db", None) is not None:
            raise InputError("engine.compress_db: few weighted paths have no direction; remove it")

    def _check_displacements(self) -> None:
        names, links = [name for name in self.parameters if displaces(name)], self.links
        refused = {
            "links.frequency": links.frequency is not None,
            f"objective.combining = {self.objective.combining!r}": self.objective.combining != "power",
            f"engine.name = {self.engine.name!r}": self.engine.name != "replay",
            "engine.rays": getattr(self.engine, "rays", None) is not None,
            "engine.compress_db": getattr(self.engine, "compress_db", None) is not None,
            "engine.chunk_links": getattr(self.engine, "chunk_links", None) is not None,
        }
        for key, stated in refused.items():
            if names and stated:
                raise InputError(
                    f"parameters: {names[0]!r}: path loss between traced positions is interpolated on replay, at one "
                    f"carrier; it does not go with {key}"
                )
        own = [
            name for name in names if name.startswith(RECEIVER) and not name.startswith(f"{RECEIVER}{EVERY}.")
        ]
        if own and links.device is None:
            raise InputError(
                f"parameters: {own[0]!r} needs links.device, the column of the devices' names; or displace all, as "
                f"'{RECEIVER}{EVERY}.dx'"
            )

    def _check_materials(self) -> None:
        for name, material in self.materials.items():
            if material.itu is not None:
                revision = material.revision or DEFAULT_REVISION
                try:
                    itu_material(material.itu, self.scene.frequency, revision=revision)
                except InputError as error:
                    raise InputError(f"{dotted(('materials', name))}: {error}") from None

    def _check_parameters(self) -> None:
        """Check all that does not need the scene; `parameter_set` checks the rest."""
        frequency, parameters = self.scene.frequency, []
        for name, entry in self.parameters.items():
            start = itu_start(name, entry.start, frequency) if isinstance(entry.start, str) else entry.start
            lower, upper = entry.bounds
            parameters.append(Parameter(name, lower, upper, lower if start is None else start, entry.scale))
            if entry.spread is not None and not name.startswith(f"{POSE}{EVERY}."):
                raise InputError(
                    f"{name}: spread is that of a population of transmitters; give it to '{POSE}{EVERY}.azimuth' or "
                    "another field, or leave it out"
                )
            if entry.prior is not None and entry.prior.std is not None:
                if not name.startswith((POSE, RECEIVER)):
                    raise InputError(f"{name}: prior.std is for antennas; give itu or value, and spread")
            elif entry.prior is not None:
                entry.centre(name, frequency)
                self._check_like(name, entry.prior.like)
        Parameters(tuple(parameters))

    def _check_like(self, name: str, like: str | None) -> None:
        if like is None:
            return
        other = self.parameters.get(like)
        if other is None or like == name:
            raise InputError(
                f"{name}: prior.like = {like!r}: no other parameter; {did_you_mean(like, self.parameters)}"
            )
        if split_name(like)[1] != split_name(name)[1]:
            raise InputError(f"{name}: prior.like = {like!r}: must be of the same constant")
        if other.prior is not None and other.prior.like is not None:
            raise InputError(f"{name}: prior.like = {like!r}: is itself like another; name that one")
        if not other.bounds[0] > 0:
            raise InputError(f"{name}: prior.like = {like!r}: its lower bound must be greater than 0")

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
    def rays_path(self) -> Path | None:
        """The ray table that is replayed, if there is one."""
        file = self.engine.rays if isinstance(self.engine, ReplaySection) else None
        return None if file is None else self._resolve("engine.rays", file)

    @property
    def observable_paths(self) -> dict[str, Path]:
        """The file of every observable that is computed from one, by name."""
        return {
            name: self._resolve(f"observables.{name}.file", section.file)
            for name, section in self.observables.items()
            if section.file is not None
        }

    @property
    def region_paths(self) -> dict[str, Path | None]:
        """The file of every region by name; None for one of boxes."""
        return {
            name: section.source and self._resolve(f"regions.{name}.{section.source[0]}", section.source[1])
            for name, section in self.regions.items()
        }

    @property
    def facade_paths(self) -> dict[str, Path | None]:
        """The file of every facade by name; None without one."""
        return {
            name: None if section.file is None else self._resolve(f"facades.{name}.file", section.file)
            for name, section in self.facades.items()
        }

    @property
    def antenna_pair(self) -> tuple[Antenna, Antenna]:
        """The transmit and the receive antenna that links are traced with, with resolved paths of gain tables.

        An end whose antennas differ between links is traced with an isotropic vertical one.
        """
        mounted, (tx, rx) = self.links.mountings, self.stated_antennas.values()
        return Antenna() if "tx" in mounted else tx, Antenna() if "rx" in mounted else rx

    @property
    def stated_antennas(self) -> dict[str, Antenna]:
        """The antennas of both ends, "tx" and "rx", with resolved paths of gain tables."""
        return {name: self._antenna(name, getattr(self.antennas, name)) for name in ("tx", "rx")}

    @property
    def antenna_types(self) -> dict[str, Antenna]:
        """The antennas of ``[antennas.types]`` by name, with resolved paths of gain tables."""
        return {
            name: self._antenna(f"types.{name}", antenna) for name, antenna in self.antennas.types.items()
        }

    def _antenna(self, key: str, antenna: Antenna) -> Antenna:
        if antenna.gain_file is None:
            return antenna
        file = self._resolve(f"antennas.{key}.pattern", antenna.pattern).resolve()
        array = antenna.rows, antenna.columns, antenna.spacing
        return Antenna(str(file), antenna.polarization, antenna.orientation, *array)

    @property
    def overrides(self) -> dict[str, dict[str, Any]]:
        """The constants that ``[materials]`` states for the scene's materials, by name."""
        return self._stated_constants(of_facades=False)

    def _stated_constants(self, of_facades: bool) -> dict[str, dict[str, Any]]:
        return {
            name: material.model_dump(exclude_none=True, exclude={ROUGHNESS})
            for name, material in self.materials.items()
            if (name in self.facades) == of_facades
        }

    @property
    def facade_constants(self) -> dict[str, dict[str, Any]]:
        """The constants that ``[materials]`` states for facades, by name."""
        return self._stated_constants(of_facades=True)

    @property
    def roughness_mm(self) -> dict[str, float]:
        """Standard deviation of the surface heights by material, where ``[materials]`` states it [mm]."""
        stated = {name: material.roughness_mm for name, material in self.materials.items()}
        return {name: height for name, height in stated.items() if height is not None}

    @property
    def nuisance_terms(self) -> dict[str, NuisanceTerm]:
        """All nuisance terms by name, the offset first."""
        offset = {} if self.offset is None else {OFFSET: self.offset.term()}
        return offset | {name: section.term() for name, section in self.nuisance.items()}

    @property
    def uses_obstruction(self) -> bool:
        """Whether a nuisance is by a column that follows from the scene."""
        return any(section.by in OBSTRUCTION for section in self.nuisance.values())

    @property
    def uses_clutter(self) -> bool:
        """Whether a nuisance is by the clutter loss of ITU-R P.2108."""
        return any(section.by == CLUTTER for section in self.nuisance.values())

    @property
    def offset_groups(self) -> tuple[str, ...]:
        """The columns whose labels group the offset; none for one offset, or without an offset."""
        return () if self.offset is None else self.offset.term().per

    @property
    def priors(self) -> LogNormal:
        """The priors of the parameters, by their indices in a candidate."""
        priors, linear = [], []
        for index, (name, entry) in enumerate(self.parameters.items()):
            if entry.prior is not None and entry.prior.std is not None:
                priors.append((index, float(entry.start or 0.0), entry.prior.std))
                linear.append(index)
            elif entry.prior is not None:
                priors.append((index, entry.centre(name, self.scene.frequency), entry.prior.spread))
        indices, centres, spreads = zip(*priors, strict=True) if priors else ((), (), ())
        names = list(self.parameters)
        like = [
            (names.index(name), names.index(entry.prior.like))
            for name, entry in self.parameters.items()
            if entry.prior is not None and entry.prior.like is not None
        ]
        return LogNormal(indices, centres, spreads, tuple(linear), tuple(like))

    def parameter_set(
        self, base: Mapping[str, Material], laws: Mapping[str, ItuLaw] | None = None
    ) -> Parameters:
        """The free parameters of a scene with materials `base`, with their start values, in the order of the file.

        Materials without a law over frequency in `laws` are constant.

        Raises:
            InputError: The scene lacks a parameter's material, or a start value is outside its bounds.
        """
        frequency = self.scene.frequency
        try:
            items = tuple(
                self._effect_parameter(name, base)
                if is_effect(name)
                else make_parameter(name, entry.bounds, base, frequency, entry.start, entry.scale, laws)
                for name, entry in self.parameters.items()
            )
            all_laws = {name: frequency_independent_law(material) for name, material in base.items()} | dict(
                laws or {}
            )
            # A parameter that is a coefficient of a law, not a constant, needs its material's law.
            needed = {item.material: all_laws[item.material] for item in items if item.field != item.constant}
            parameters = Parameters(items, frequency, needed)
            parameters.check_carriers([frequency])
        except InputError as error:
            raise InputError(f"{self._path}: {error}") from None
        return parameters

    def _effect_parameter(self, name: str, materials: Collection[str]) -> Parameter:
        """The parameter of a region or rough surface, or of a transmit antenna, whose stated pose is the start 0."""
        entry = self.parameters[name]
        if name.endswith(f".{ROUGHNESS}"):
            check_material(name, materials)
            stated = self.roughness_mm.get(split_name(name)[0], 0.0)
            return Parameter(
                name, *entry.bounds, stated if entry.start is None else float(entry.start), entry.scale
            )
        region = self.regions.get(name.removeprefix(PREFIX).rpartition(".")[0]) if PREFIX in name else None
        start = 0.0 if region is None else region.specific_attenuation
        return Parameter(
            name, *entry.bounds, start if entry.start is None else float(entry.start), entry.scale
        )

    def content(self) -> dict[str, Any]:
        """The study as plain values with every default written out; `Study.from_content` reads it."""
        content = self.model_dump(mode="json", exclude_none=True)
        content["engine"] |= self._other_engines
        return content

    def digest(self) -> str:
        """Fingerprint of the study: SHA-256 of its content, however the file is laid out.

        The order of the parameters counts, because it is the order of a candidate's values. The content of the files
        that it names does not.
        """
        content = self.content() | {"parameters": list(self.content()["parameters"].items())}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def files(self) -> tuple[Path, ...]:
        """The study file and the files that it names, except those of a bundled scene."""
        return (self._path, *(file for _, _, file in self._named_files()))

    def check_files(self) -> None:
        """Check that the files exist.

        Raises:
            InputError: One does not exist.
        """
        for name, stated, file in self._named_files():
            if not exists(file):
                raise InputError(
                    f"{self._path}: {name} = {shortened(stated)!r}: no such file, "
                    f"{shortened(str(file.absolute()), 300)}"
                )

    def _named_files(self) -> list[tuple[str, str, Path]]:
        """Key, stated name and path of the files that the study names."""
        links = self.links
        files: list[tuple[str, str | None, Path | None]] = [
            ("links.file", links.file, self.links_path),
            ("links.transmitters", links.transmitters, self.transmitters_path),
            ("links.track.file", links.track and links.track.file, self.track_path),
            ("engine.rays", getattr(self.engine, "rays", None), self.rays_path),
        ]
        for name, path in self.region_paths.items():
            key, stated = self.regions[name].source or ("boxes", None)
            files.append((f"regions.{name}.{key}", stated, path))
        for name, path in self.facade_paths.items():
            files.append((f"facades.{name}.file", self.facades[name].file, path))
        for name, path in self.observable_paths.items():
            files.append((f"observables.{name}.file", self.observables[name].file, path))
        if not self.scene.file.startswith(BUNDLED):
            files.append(("scene.file", self.scene.file, Path(self.scene_source)))
        written = [("tx", self.antennas.tx), ("rx", self.antennas.rx)]
        written += [(f"types.{name}", antenna) for name, antenna in self.antennas.types.items()]
        for key, antenna in written:
            if (file := self._antenna(key, antenna).gain_file) is not None:
                files.append((f"antennas.{key}.pattern", antenna.pattern, Path(file)))
        return [
            (name, written, path) for name, written, path in files if written is not None and path is not None
        ]

    def _resolve(self, name: str, file: str) -> Path:
        try:
            return self._path.parent / expand(file, os.environ)
        except InputError as error:
            raise InputError(f"{self._path}: {name} = {file!r}: {error}") from None
