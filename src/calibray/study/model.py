"""The content of a study file, and the quantities derived from it without reading other files."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from abc import ABC
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from calibray.engines.kinds.replay import ReplaySection
from calibray.errors import InputError
from calibray.materials import ItuLaw, Material, frequency_independent_law
from calibray.measurements import Measurements
from calibray.parameters import LogNormal, Parameter, Parameters, is_effect, split_name, start_value
from calibray.parameters.parameter import ROUGHNESS, check_material
from calibray.scenes.obstruction import CLUTTER
from calibray.scenes.obstruction import COLUMNS as OBSTRUCTION
from calibray.study.calibration_sections import OFFSET, NuisanceTerm
from calibray.study.content import BUNDLED, StudyContent
from calibray.study.regions import PREFIX
from calibray.study.toml_file import expand, is_shared, read_content, refuse_unquoted_names, split_engine_keys
from calibray.support.messages import shortened, type_name
from calibray.support.output_files import as_path, exists
from calibray.support.strict_models import dotted, explain
from calibray.tracing.settings import Antenna

_LOG: Final = logging.getLogger(__name__)

_NEEDED: Final = {
    "regions": {"position": "file"},
    "facades": {"position": "file", "module": "share", "storey_height": "storeys"},
}
"""Keys that have no effect without another key in the same table, by section."""


class StudyModel(StudyContent, ABC):
    """The content of a study file; the public class is `calibray.Study`."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a study file.

        Raises:
            InputError: The file does not exist, is not TOML, has an unknown key or an invalid value, or names a file
                that does not exist. The message has one line per error.
        """
        path = as_path(path, "study")
        content = read_content(path)
        study = cls.from_content(content, path)
        study.check_files()
        for key, needed in _keys_without_effect(content):
            _LOG.warning("%s: %s has no effect without %s; remove this key", path, key, needed)
        if len(others := study._other_engines) == 1 and is_shared(key := next(iter(others))):
            _LOG.warning(
                "%s: engine.%s = %r has no effect with engine.name = %r; correct or remove it",
                path, key, others[key], study.engine.name,
            )  # fmt: skip
        return study

    @classmethod
    def from_content(cls, content: Mapping[str, Any], path: str | Path = "study.toml") -> Self:
        """Create a study from sections structured as in TOML, without checking that the named files exist.

        File names are relative to the folder of `path`, and `path` need not exist.

        Raises:
            InputError: A key is unknown or a value is invalid. The message has one line per error.
        """
        if not isinstance(content, Mapping):
            raise InputError(
                f"{path}: is a {type_name(content)}, must be a dictionary with the sections of a study"
            )
        refuse_unquoted_names(content.get("parameters"), path)
        engine, other_engines = split_engine_keys(content.get("engine", {}), str(path))
        content = {**content, "engine": engine}
        try:
            # Validation of JSON accepts a list as a tuple but converts nothing else: "4" is not a number.
            text = json.dumps(content, default=_plain)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: a value cannot be used ({error}); correct this value") from None
        try:
            study = cls.model_validate_json(text)
        except ValidationError as error:
            refusal = explain(error, cls, content, str(path), tagged=("engine",))
            raise refusal from None
        study._path, study._other_engines = Path(path), other_engines
        return study

    def __reduce__(self) -> tuple[Any, ...]:
        # File names are relative to the study file, and another process may have a different working folder.
        return type(self).from_content, (self.content(), self._path.absolute())

    @property
    def path(self) -> Path:
        """The study file."""
        return self._path

    @property
    def allows_blocks(self) -> bool:
        """Whether blocks of links can be held out in turn; this is too expensive without replay."""
        replaced = self.engine.exports_rays and self.method.name == "auto"
        return self.engine.name == "replay" or replaced

    @property
    def holds_out_blocks(self) -> bool:
        """Whether a calibration holds out blocks of links in turn."""
        return self.holdout is not None and self.holdout.where is None

    @property
    def scene_source(self) -> str:
        """The path of the scene file, or "sionna:NAME"."""
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
        """The table of transmitters; None if there is no such table."""
        file = self.links.transmitters
        return None if file is None else self._resolve("links.transmitters", file)

    @property
    def track_path(self) -> Path | None:
        """The track; None without a track."""
        track = self.links.track
        return None if track is None else self._resolve("links.track.file", track.file)

    @property
    def rays_path(self) -> Path | None:
        """The ray table that is replayed; None if there is no such table."""
        file = self.engine.rays if isinstance(self.engine, ReplaySection) else None
        return None if file is None else self._resolve("engine.rays", file)

    @property
    def observable_paths(self) -> dict[str, Path]:
        """The files from which observables are computed, keyed by the name of the observable."""
        return {
            name: self._resolve(f"observables.{name}.file", section.file)
            for name, section in self.observables.items()
            if section.file is not None
        }

    @property
    def region_paths(self) -> dict[str, Path | None]:
        """The file of each region, by region name; None for a region of boxes."""
        return {
            name: section.source and self._resolve(f"regions.{name}.{section.source[0]}", section.source[1])
            for name, section in self.regions.items()
        }

    @property
    def facade_paths(self) -> dict[str, Path | None]:
        """The file of each facade, by facade name; None for a facade without a file."""
        return {
            name: None if section.file is None else self._resolve(f"facades.{name}.file", section.file)
            for name, section in self.facades.items()
        }

    @property
    def antenna_pair(self) -> tuple[Antenna, Antenna]:
        """The transmit and receive antennas for tracing, with resolved paths of gain tables.

        If the antennas at one end differ between links, tracing uses an isotropic vertical antenna at that end.
        """
        mounted, (tx, rx) = self.links.mountings, self.stated_antennas.values()
        return Antenna() if "tx" in mounted else tx, Antenna() if "rx" in mounted else rx

    @property
    def stated_antennas(self) -> dict[str, Antenna]:
        """The antennas at both ends ("tx" and "rx"), with resolved paths of gain tables."""
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
        """The constants in ``[materials]`` for materials of the scene, by material name."""
        return self._stated_constants(of_facades=False)

    def _stated_constants(self, of_facades: bool) -> dict[str, dict[str, Any]]:
        return {
            name: material.model_dump(exclude_none=True, exclude={ROUGHNESS})
            for name, material in self.materials.items()
            if (name in self.facades) == of_facades
        }

    @property
    def facade_constants(self) -> dict[str, dict[str, Any]]:
        """The constants in ``[materials]`` for facades, by facade name."""
        return self._stated_constants(of_facades=True)

    @property
    def roughness_mm(self) -> dict[str, float]:
        """Standard deviations [mm] of the surface height, stated in ``[materials]``, by material name."""
        stated = {name: material.roughness_mm for name, material in self.materials.items()}
        return {name: height for name, height in stated.items() if height is not None}

    @property
    def nuisance_terms(self) -> dict[str, NuisanceTerm]:
        """All nuisance terms by name; the offset comes first."""
        offset = {} if self.offset is None else {OFFSET: self.offset.term()}
        return offset | {name: section.term() for name, section in self.nuisance.items()}

    @property
    def uses_obstruction(self) -> bool:
        """Whether a nuisance term uses a column computed from the scene or clusters of receivers."""
        by_scene = any(section.by in OBSTRUCTION for section in self.nuisance.values())
        return by_scene or self.cluster_m is not None

    @property
    def cluster_m(self) -> float | None:
        """Side length [m] of the squares that group receivers for a nuisance term; None if no term has such groups."""
        return next((item.cluster_m for item in self.nuisance.values() if item.cluster_m is not None), None)

    @property
    def uses_clutter(self) -> bool:
        """Whether a nuisance term uses the clutter loss of ITU-R P.2108."""
        return any(section.by == CLUTTER for section in self.nuisance.values())

    @property
    def offset_groups(self) -> tuple[str, ...]:
        """The columns whose labels define the groups of the offset; empty if there is no offset or a single offset."""
        return () if self.offset is None else self.offset.term().per

    @property
    def priors(self) -> LogNormal:
        """The priors, with the index of each parameter in a candidate."""
        priors, linear = [], []
        for index, (name, entry) in enumerate(self.parameters.items()):
            if entry.prior is not None and entry.prior.std is not None:
                # Antennas have additive errors around the stated pose. Material constants are positive, so their priors
                # apply to the logarithm.
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
        """The parameters, in the order of the file, with their start values for a scene with materials `base`.

        The constants of materials without a frequency law in `laws` do not depend on frequency.

        Raises:
            InputError: The scene lacks the material of a parameter, or a start value is outside the bounds.
        """
        frequency = self.scene.frequency
        try:
            items = tuple(
                self._effect_parameter(name, base)
                if is_effect(name)
                else Parameter(
                    name, *entry.bounds, start_value(name, entry.start, base, frequency, laws), entry.scale
                )
                for name, entry in self.parameters.items()
            )
            all_laws = {name: frequency_independent_law(material) for name, material in base.items()} | dict(
                laws or {}
            )
            # A coefficient of a frequency law needs the law of its material.
            needed = {item.material: all_laws[item.material] for item in items if item.field != item.constant}
            parameters = Parameters(items, frequency, needed)
            parameters.check_carriers([frequency])
        except InputError as error:
            raise InputError(f"{self._path}: {error}") from None
        return parameters

    def _effect_parameter(self, name: str, materials: Collection[str]) -> Parameter:
        """The parameter of a region, a rough surface or an antenna. For an antenna, 0 stands for the stated pose."""
        entry = self.parameters[name]
        if name.endswith(f".{ROUGHNESS}"):
            check_material(name, materials)
            stated = self.roughness_mm.get(split_name(name)[0], 0.0)
            return Parameter(
                name, *entry.bounds, stated if entry.start is None else float(entry.start), entry.scale
            )
        region = self.regions.get(name.removeprefix(PREFIX).rpartition(".")[0]) if PREFIX in name else None
        # Antennas start at their stated pose, which has an error of 0.
        start = 0.0 if region is None else region.specific_attenuation
        return Parameter(
            name, *entry.bounds, start if entry.start is None else float(entry.start), entry.scale
        )

    def content(self) -> dict[str, Any]:
        """The study as a dictionary with all defaults, which `Study.from_content` can read."""
        content = self.model_dump(mode="json", exclude_none=True)
        # Keep the keys of other engines, because `replace` may select one of these engines.
        content["engine"] |= self._other_engines
        return content

    def digest(self) -> str:
        """SHA-256 digest of the content of the study, independent of the layout of the file.

        The digest depends on the order of the parameters, because the values of a candidate have the same order. It
        does not depend on the contents of the named files.
        """
        content = self.content() | {"parameters": list(self.content()["parameters"].items())}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def files(self) -> tuple[Path, ...]:
        """The study file and the files that it names, except the files of a bundled scene."""
        return (self._path, *(file for _, _, file in self._named_files()))

    def check_files(self) -> None:
        """Check that the files exist.

        Raises:
            InputError: A file does not exist.
        """
        for name, stated, file in self._named_files():
            if not exists(file):
                remedy = (
                    "; to create this file, use calibray.read_rays and calibray.write_rays with a study without "
                    "engine.rays"
                )
                raise InputError(
                    f"{self._path}: {name} = {shortened(stated)!r}: no such file, "
                    f"{shortened(str(file.absolute()), 300)}{remedy if name == 'engine.rays' else ''}"
                )

    def _named_files(self) -> list[tuple[str, str, Path]]:
        """Key, stated name and path of each file that the study names."""
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

    def held_out(self, links: Measurements) -> NDArray[np.bool_]:
        """Mask [L] of the held-out links; all False without ``[holdout]`` or if links are held out in turn.

        Raises:
            InputError: The filter is malformed, names a missing column, or selects all links or none; or the links lack
                the column of labels that ``[holdout]`` names.
        """
        # A missing column must raise an error here, before tracing.
        if self.holdout is not None and self.holdout.by not in (None, "tx", *OBSTRUCTION):
            links.table.labels(self.holdout.by)
        if self.holdout is None or self.holdout.where is None:
            return np.zeros(len(links), dtype=bool)
        return links.held_out(self.holdout.where)

    def replace(self, method: str | None = None, seed: int | None = None, engine: str | None = None) -> Self:
        """The study with another method, seed or engine. A new method does not keep the options of the old method.

        Raises:
            InputError: A value is invalid.
        """
        content = self.content()
        if method is not None and method != self.method.name:
            content["method"] = {"name": method, "seed": self.method.seed, "model": self.method.model}
        if seed is not None:
            content["method"]["seed"] = seed
        if engine is not None:
            content["engine"]["name"] = engine
        return type(self).from_content(content, self._path)


def _plain(value: object) -> Any:
    """NumPy numbers and arrays as Python numbers and lists, and all other values as text."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


def _keys_without_effect(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The keys of a valid study file that have no effect, each with the missing key on which it depends."""
    for section, keys in _NEEDED.items():
        for name, table in content.get(section, {}).items():
            for key, needed in keys.items():
                if key in table and needed not in table:
                    yield dotted((section, name, key)), needed
    trace = content.get("trace", {})
    for key, default in (("edge_diffraction", False), ("diffraction_lit_region", True)):
        if trace.get(key, default) != default and not trace.get("diffraction", False):
            yield f"trace.{key}", "diffraction = true"
