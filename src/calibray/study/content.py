"""All sections of a study file, and checks for keys that cannot be combined."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Self

from pydantic import Field, PrivateAttr, field_validator, model_validator

from calibray.engines.kinds import AnyEngine, default
from calibray.errors import InputError
from calibray.materials import DEFAULT_REVISION, itu_material
from calibray.parameters import Parameter, Parameters, itu_start, split_name
from calibray.parameters.parameter import ROUGHNESS
from calibray.scenes.obstruction import REGION
from calibray.study import calibration_sections as sections
from calibray.study.displacement import RECEIVER, displaces
from calibray.study.facades import FacadeSection
from calibray.study.observables import ObservableSection, by_column
from calibray.study.regions import PREFIX, RegionSection
from calibray.study.sections import AntennasSection, LinksSection, MaterialSection, SceneSection, TraceSection
from calibray.support.messages import did_you_mean
from calibray.support.strict_models import Section, Text, dotted
from calibray.tracing.antennas import EVERY, POSE, turns

VERSION: Final = 1
"""Version of the study file format that this module reads."""

BUNDLED: Final = "sionna:"
"""Prefix of the name of a scene bundled with Sionna RT."""


def _first_stated(keys: Mapping[str, bool]) -> str | None:
    return next((key for key, stated in keys.items() if stated), None)


class StudyContent(Section, ABC):
    """The sections of a study file, with checks for keys that cannot be combined."""

    version: int
    scene: SceneSection
    objects: dict[str, Text] = Field(default_factory=dict)
    materials: dict[str, MaterialSection] = Field(default_factory=dict)
    facades: dict[str, FacadeSection] = Field(default_factory=dict)
    links: LinksSection
    antennas: AntennasSection = Field(default_factory=AntennasSection)
    trace: TraceSection = Field(default_factory=TraceSection)  # type: ignore[valid-type]
    objective: sections.ObjectiveSection = Field(default_factory=sections.ObjectiveSection)
    parameters: dict[str, sections.ParameterSection]
    observables: dict[str, ObservableSection] = Field(default_factory=dict)
    regions: dict[str, RegionSection] = Field(default_factory=dict)
    offset: sections.OffsetSection | None = None
    nuisance: dict[str, sections.NuisanceSection] = Field(default_factory=dict)
    noise: sections.NoiseSection = Field(default_factory=sections.NoiseSection)
    holdout: sections.HoldoutSection | None = None
    fidelity: sections.FidelitySection = Field(default_factory=sections.FidelitySection)
    method: sections.MethodSection = Field(default_factory=sections.MethodSection)
    engine: AnyEngine = Field(default_factory=default)

    _path: Path = PrivateAttr(default=Path("study.toml"))
    _other_engines: dict[str, Any] = PrivateAttr(default_factory=dict)

    @field_validator("version")
    @classmethod
    def _known_version(cls, value: int) -> int:
        if value != VERSION:
            raise InputError(
                f"this version of Calibray reads only study files of version {VERSION}; convert the file, or install a "
                "version of Calibray that can read this file"
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
                "links.quantity = 'rsrp' needs [offset]: the transmitted power is unknown and becomes part of the "
                "offset"
            )
        if self.links.quantity == "rsrp" and self.objective.ceiling_db is not None:
            raise InputError(
                "objective.no_path = 'censor' with links.quantity = 'rsrp': the largest path loss is unknown, because "
                "the transmitted power is unknown; state the power (links.tx_power_dbm), or set no_path = 'exclude'"
            )
        if self.links.below_floor == "censor" and self.noise.range_m not in ("auto", 0):
            raise InputError(
                f"links.below_floor = 'censor' with noise.range_m = {self.noise.range_m:g}: the errors of censored "
                "links are assumed to be independent; remove one of these keys"
            )
        self._check_rays()
        self._check_observables()
        self._check_losses()
        self._check_poses()
        self._check_position_errors()
        reserved = (sections.OFFSET, sections.FREE_OFFSET, sections.TX_OFFSET)
        for name in self.nuisance:
            if name in reserved or name.endswith(sections.OF_ALL_LINKS):
                raise InputError(f"nuisance.{name}: Calibray itself uses this name; choose another name")
        if getattr(self.engine, "rays", None) and (
            self.links.mountings or self.links.position_error_m is not None
        ):
            raise InputError(
                "the paths in engine.rays apply to one position and one antenna at each end: remove links.tx_antenna, "
                "links.rx_antenna and links.position_error_m"
            )
        if self.links.mountings and self.engine.name != "replay":
            end = next(iter(self.links.mountings))
            raise InputError(
                f"links.{end}_antenna with engine.name = {self.engine.name!r}: antennas that differ between links need "
                "stored paths; use engine 'replay'"
            )
        self._check_materials()
        self._check_parameters()
        return self

    def _check_rays(self) -> None:
        refused = {
            f"objective.combining = {self.objective.combining!r}": self.objective.combining != "power",
            "links.frequency": self.links.frequency is not None,
            "[observables]": bool(self.observables),
            **self._laws(),
        }
        key = _first_stated(refused)
        if isinstance(getattr(self.engine, "rays", None), str) and self.links.frequency is not None:
            raise InputError(
                "engine.rays with links.frequency: a ray table contains powers at one carrier; remove links.frequency, "
                "or create a study and an export for each carrier"
            )
        if self.engine.exports_rays and key is not None:
            raise InputError(
                f"engine.rays = true adds and compares ray powers at one carrier, so it cannot be combined with {key}; "
                "remove one of the two"
            )

    def _laws(self) -> dict[str, bool]:
        """Whether any parameter is a coefficient of a frequency law, keyed by a label for messages."""
        return {
            "coefficients of laws": any(split_name(name)[1].startswith("itu_") for name in self.parameters)
        }

    def _without_replay(self) -> dict[str, bool]:
        """Settings that rule out replay of summed powers at one carrier, and whether the study states each of them."""
        return {
            "links.frequency": self.links.frequency is not None,
            f"objective.combining = {self.objective.combining!r}": self.objective.combining != "power",
            f"engine.name = {self.engine.name!r}": self.engine.name != "replay",
            **self._laws(),
        }

    def _check_observables(self) -> None:
        if not self.observables:
            return
        if getattr(self.engine, "compress_db", None) is not None:
            raise InputError(
                "engine.compress_db: compression to a few weighted paths preserves path loss, but not the delays and "
                "angles that [observables] need; remove one of the two"
            )
        if self.engine.name == "retrace":
            raise InputError(
                "[observables] cannot be used with engine.name = 'retrace'; use 'replay' or 'command'"
            )
        unstated = [name for name, section in self.observables.items() if section.std is None]
        if self.engine.expensive and (unstated or (self.links.std is None and self.noise.std_db is None)):
            missing = f"observables.{unstated[0]}.std" if unstated else "noise.std_db"
            raise InputError(
                f"{missing}: is required, because observables are weighted by their errors, which cannot be estimated "
                f"from the few calls of the engine {self.engine.name!r}"
            )

    def _check_losses(self) -> None:
        for name in self.parameters:
            region = name.removeprefix(PREFIX).rpartition(".")[0]
            if name.startswith(PREFIX) and region not in self.regions:
                raise InputError(
                    f"parameters: {name!r}: no [regions.{region}]; {did_you_mean(region, self.regions)}"
                )
        if self.facades and getattr(self.engine, "rays", None):
            raise InputError("engine.rays: the rays of a table are not assigned to walls; remove [facades]")
        if len({item.cluster_m for item in self.nuisance.values()} - {None}) > 1:
            raise InputError(
                "nuisance: cluster_m differs between terms; state the same side length for all terms"
            )
        for name, section in self.nuisance.items():
            if section.by == REGION and not self.regions:
                raise InputError(
                    f"nuisance.{name}.by = {REGION!r}: this column needs [regions], and the study has none"
                )
        rough = [name for name in self.parameters if name.endswith(f".{ROUGHNESS}")]
        rough += [
            f"materials.{name}.{ROUGHNESS}"
            for name, m in self.materials.items()
            if m.roughness_mm is not None
        ]
        stated = (("[regions]", self.regions), ("[facades]", self.facades), ("".join(rough[:1]), rough))
        for key, used in stated:
            if used and self.engine.name != "replay":
                raise InputError(
                    f"{key} needs engine.name = 'replay'; the engine {self.engine.name!r} stores no paths"
                )
            if used and getattr(self.engine, "compress_db", None) is not None:
                raise InputError(
                    f"engine.compress_db: compression to a few weighted paths cannot be combined with {key}; remove "
                    "one of the two"
                )

    def _check_position_errors(self) -> None:
        links = self.links
        if links.position_error_m is None:
            return
        stated = {"links.weight": links.weight is not None, "[observables]": bool(self.observables)}
        key = _first_stated(stated | self._without_replay())
        if key is not None:
            raise InputError(
                "links.position_error_m averages powers at displaced receivers by replay at one carrier; this key "
                f"cannot be combined with {key}"
            )
        if links.std is None and self.noise.std_db is None:
            raise InputError(
                "links.position_error_m also needs the other errors of a link: give links.std or noise.std_db [dB]"
            )

    def _check_poses(self) -> None:
        self._check_displacements()
        names = [name for name in self.parameters if turns(name)]
        if names and self.links.tx_antenna is None:
            raise InputError(
                f"parameters: {names[0]!r} needs [links.tx_antenna], which states the directions of the transmit "
                "antennas"
            )
        if names and getattr(self.engine, "compress_db", None) is not None:
            raise InputError(
                f"engine.compress_db: compressed paths lack the directions that {names[0]!r} needs; remove "
                "engine.compress_db"
            )

    def _check_displacements(self) -> None:
        names, links = [name for name in self.parameters if displaces(name)], self.links
        of_engine = ("rays", "compress_db", "chunk_links")
        stated = {f"engine.{key}": getattr(self.engine, key, None) is not None for key in of_engine}
        key = _first_stated(self._without_replay() | stated)
        if names and key is not None:
            raise InputError(
                f"parameters: {names[0]!r}: a displacement needs the engine 'replay' at one carrier, because path loss "
                f"is interpolated between traced positions; it cannot be combined with {key}"
            )
        own = [
            name for name in names if name.startswith(RECEIVER) and not name.startswith(f"{RECEIVER}{EVERY}.")
        ]
        if own and links.device is None:
            raise InputError(
                f"parameters: {own[0]!r} needs links.device, the column of device names; alternatively, displace all "
                f"devices with '{RECEIVER}{EVERY}.dx'"
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
        """Check the parameters as far as possible without the scene; `parameter_set` makes the remaining checks."""
        frequency, parameters = self.scene.frequency, []
        for name, entry in self.parameters.items():
            start = itu_start(name, entry.start, frequency) if isinstance(entry.start, str) else entry.start
            lower, upper = entry.bounds
            parameters.append(Parameter(name, lower, upper, lower if start is None else start, entry.scale))
            if entry.spread is not None and not name.startswith(f"{POSE}{EVERY}."):
                raise InputError(
                    f"{name}: spread describes a population of transmitters; state it for a parameter of all "
                    f"transmitters, such as '{POSE}{EVERY}.azimuth', or remove it"
                )
            if entry.prior is not None and entry.prior.std is not None:
                if not name.startswith((POSE, RECEIVER)):
                    raise InputError(
                        f"{name}: prior.std applies only to parameters of antennas; give itu or value, and spread"
                    )
            elif entry.prior is not None:
                entry.centre(name, frequency)
                self._check_like(name, entry.prior.like)
        Parameters(tuple(parameters))

    def _check_like(self, name: str, like: str | None) -> None:
        if like is None:
            return
        other, others = self.parameters.get(like), [known for known in self.parameters if known != name]
        if other is None or like == name:
            raise InputError(
                f"{name}: prior.like = {like!r}: must name another parameter; {did_you_mean(like, others)}"
            )
        if split_name(like)[1] != split_name(name)[1]:
            raise InputError(f"{name}: prior.like = {like!r}: must be a parameter of the same constant")
        if other.prior is not None and other.prior.like is not None:
            raise InputError(
                f"{name}: prior.like = {like!r}: is itself centred on another parameter; give the latter"
            )
        if not other.bounds[0] > 0:
            raise InputError(
                f"{name}: prior.like = {like!r}: the lower bound of this parameter must be greater than 0"
            )
