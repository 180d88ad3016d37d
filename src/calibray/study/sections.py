"""The sections of a study file for the scene, the links and the antennas. Unknown keys are errors."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic.dataclasses import dataclass as checked

from calibray.errors import InputError
from calibray.materials import FREQUENCIES, Material
from calibray.measurements import Quantity
from calibray.support.strict_models import CLOSED, Section, Text
from calibray.tracing.settings import Antenna, TraceSettings

_Antenna = checked(Antenna, config=CLOSED, frozen=True)
TraceSection = checked(TraceSettings, config=CLOSED, frozen=True)

Coordinate = float | str
Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]


class SceneSection(Section):
    """``[scene]``: the scene and the carrier.

    Attributes:
        file: Mitsuba XML file, relative to the study file's folder, or "sionna:NAME" for a bundled scene.
        frequency: Carrier frequency [Hz].
        bandwidth: Bandwidth [Hz] over which power is averaged.
        origin: Longitude and latitude [deg] of the origin of the scene, for geographic positions.
        crs: Projection of the x and y coordinates of the scene, for instance "EPSG:32632". If absent, a local
            projection around the origin is used.
    """

    file: Text
    frequency: float
    bandwidth: Annotated[float, Field(gt=0)] | None = None
    origin: tuple[Longitude, Latitude] | None = None
    crs: Text | None = None

    @field_validator("frequency")
    @classmethod
    def _in_hertz(cls, value: float) -> float:
        lowest, highest = FREQUENCIES
        if not lowest <= value <= highest:
            raise InputError(f"must be from {lowest:g} to {highest:g} Hz; write 28.5 GHz as 28.5e9")
        return value


class MaterialSection(Section):
    """One entry of ``[materials]``: constants that override those in the scene.

    Attributes:
        itu: Name of the ITU-R P.2040 material that determines permittivity and conductivity.
        revision: Revision of ITU-R P.2040; allowed only with `itu`.
        relative_permittivity: Real part of the relative permittivity [1].
        conductivity: Conductivity [S/m].
        thickness: Thickness [m].
        scattering_coefficient: Scattering coefficient [1]. A value of 0 stated in the study is taken as exact, unlike a
            value of 0 in the scene.
        xpd_coefficient: Cross-polarization discrimination coefficient [1].
        scattering_pattern: "lambertian", "directive" or "backscattering".
        alpha_r: Exponent [1] of the lobe around the specular direction.
        alpha_i: Exponent [1] of the backscattering lobe towards the source.
        lambda_: Fraction [1] of the diffuse power in the lobe around the specular direction.
        roughness_mm: Standard deviation [mm] of the surface height. Roughness attenuates specular reflections.
    """

    itu: Text | None = None
    revision: Text | None = None
    relative_permittivity: float | None = None
    conductivity: float | None = None
    thickness: float | None = None
    scattering_coefficient: float | None = None
    xpd_coefficient: float | None = None
    scattering_pattern: Text | None = None
    alpha_r: float | None = None
    alpha_i: float | None = None
    lambda_: float | None = None
    roughness_mm: Annotated[float, Field(ge=0, le=1000)] | None = None

    @model_validator(mode="after")
    def _physical(self) -> Self:
        if self.revision is not None and self.itu is None:
            raise InputError(
                f"revision = {self.revision!r} without itu; name the ITU-R material or remove the revision"
            )
        stated = self.model_dump(exclude_none=True, exclude={"itu", "revision", "roughness_mm"})
        Material(**{"relative_permittivity": 1.0, "conductivity": 0.0, "thickness": 1.0, **stated})
        return self


class AverageSection(Section):
    """``[links.average]``: averaging of nearby samples into one link, in linear power.

    Attributes:
        by: "place" averages samples at the same receiver position, "cell" in cells of a square grid, "distance" in
            intervals of the travelled distance (in row order), and "time" in time windows.
        size: Width [m] of a cell, length [m] of an interval, or duration [s] of a window; required except for "place".
        time: Column of times; allowed only with "time".
        unbiased: Whether to correct for the biased logarithm of a mean over few samples.
        minimum_count: Minimum number of samples in an average; averages over fewer samples are excluded.
    """

    by: Literal["place", "cell", "distance", "time"]
    size: Annotated[float, Field(gt=0)] | None = None
    time: Text | None = None
    unbiased: bool = False
    minimum_count: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _sized_or_timed(self) -> Self:
        if (self.by == "place") != (self.size is None):
            remedy = "does not use size; remove the key" if self.by == "place" else "needs size, in m or s"
            raise InputError(f"links.average: by = {self.by!r} {remedy}")
        if (self.by == "time") != (self.time is not None):
            remedy = (
                "needs time, the column of times"
                if self.by == "time"
                else "does not use time; remove the key"
            )
            raise InputError(f"links.average: by = {self.by!r} {remedy}")
        return self


def _section_of_place(value: Any) -> Any:
    """Expand ``average = "place"``, which is short for ``average = { by = "place" }``."""
    return {"by": "place"} if value == "place" else value


_Average = Annotated[
    AverageSection | None,
    BeforeValidator(_section_of_place, json_schema_input_type=AverageSection | Literal["place"] | None),
]


class TrackSection(Section):
    """``[links.track]``: a GPX track from which the position of each row is interpolated at the time of the row.

    Attributes:
        file: GPX file, relative to the study file's folder.
        time: Column with the times of the rows, in ISO 8601 or as seconds since 1970.
        longest_gap: Longest permitted time [s] between two track points; rows in longer gaps are excluded.
        clock: Time [s] by which the clock that timed the rows is ahead of the clock of the track.
    """

    file: Text
    time: Text
    longest_gap: Annotated[float, Field(gt=0)] = 10.0
    clock: float = 0.0


class MountingSection(Section):
    """``[links.tx_antenna]`` or ``[links.rx_antenna]``: type and direction of the antenna of each link at this end.

    Attributes:
        type: Column with names from ``[antennas.types]``. If absent, all links have the antenna of ``[antennas]``.
        azimuth_deg: Azimuth [deg], a number or a column; if absent, the direction of x. This rotation is added to the
            orientation stated in ``[antennas]``.
        azimuth_from: "north" for compass bearings (measured clockwise from y), "east" for angles measured
            counter-clockwise from x.
        downtilt_deg: Mechanical downtilt [deg], a number or a column.
        electrical_downtilt_deg: Downward tilt [deg] of the pattern or, for an array, of the beam, in the frame of the
            antenna; a number or a column.
        steering_deg: Azimuth [deg] to which the beam of an array is steered electrically, relative to the antenna; a
            number or a column. This azimuth is measured clockwise if azimuths are compass bearings.
        aim: "other end" points every antenna at the other end of its link and replaces azimuth and downtilt.
    """

    type: Text | None = None
    azimuth_deg: Coordinate | None = None
    azimuth_from: Literal["north", "east"] = "north"
    downtilt_deg: Coordinate = 0.0
    electrical_downtilt_deg: Coordinate = 0.0
    steering_deg: Coordinate = 0.0
    aim: Literal["other end"] | None = None

    @model_validator(mode="after")
    def _one_direction(self) -> Self:
        if self.aim is not None and (self.azimuth_deg is not None or self.downtilt_deg != 0):
            raise InputError(
                "aim = 'other end' determines azimuth and downtilt; remove azimuth_deg and downtilt_deg"
            )
        return self

    @property
    def columns(self) -> dict[str, str]:
        """The columns of the table of links that this section names, by key."""
        keys = ("type", "azimuth_deg", "downtilt_deg", "electrical_downtilt_deg", "steering_deg")
        return {key: getattr(self, key) for key in keys if isinstance(getattr(self, key), str)}


class LinksSection(Section):
    """``[links]``: the table of measured links, and the rules that convert its rows to links.

    Attributes:
        file: CSV, Parquet or Excel file, relative to the study file's folder.
        tx: Transmitter position (x, y, z) [m], or longitude, latitude [deg] and height [m] if `position` is
            "geographic". Each coordinate is a number or a column.
        rx: Receiver position, in the same form.
        value: Column of the measured values.
        quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm] for a received power if
            the transmitted power is unknown.
        position: "scene" for metres in the scene frame, "geographic" for longitude and latitude or for coordinates in
            `crs`.
        crs: Reference system of "geographic" positions, such as EPSG:32632. If absent, positions are longitude and
            latitude.
        position_unit: Length [m] of one unit of the position columns; only with "scene".
        where: Row filter.
        weight: Column of relative weights [1].
        std: Standard deviation [dB] of the values, a number or a column.
        tx_power_dbm: Transmitted power [dBm], a number or a column; required for received powers.
        eirp_dbm: Radiated power in the main direction (EIRP) [dBm], stated instead of the transmitted power.
        cable_loss_db: Loss [dB] between transmitter and antenna, a number or a column; requires a transmitted power.
        tx_antenna: Antennas of the transmitters, if these differ between links.
        rx_antenna: Antennas of the receivers, if these differ between links.
        device: Column with the names of receiving devices, for parameters such as "rx:PHONE.dx" that displace these
            devices.
        position_error_m: Standard deviation [m] of receiver position errors along x and y, a number or a column.
        frequency: Column of carrier frequencies, in Hz or in the unit that its name states. If absent, all links have
            the carrier of ``[scene]``.
        wide: Names of the transmitters, keyed by column, for a table with one column per transmitter.
        track: GPX track from which the columns `track_longitude` and `track_latitude` [deg] are added to the rows.
        heights: "ground" for heights above the ground of the scene. If absent, heights are above the vertical datum of
            the scene frame.
        transmitters: Table with one row per transmitter, relative to the study file's folder.
        transmitter: Column with the name of the transmitter, in both tables.
        missing: Numbers that stand for missing measurements, in addition to common codes such as 100 or -999.
        noise_floor_dbm: Noise floor [dBm]. A missing received power is treated as below the noise floor.
        below_floor: Treatment of rows with received powers at or below the noise floor: "exclude" removes these rows;
            "censor" keeps them as upper bounds of the received power, which intervals take into account.
        inside: Treatment of receivers inside buildings: "keep", "drop", or "move" to the nearest point outside.
        average: Rule by which samples are averaged.
    """

    file: Text
    tx: tuple[Coordinate, Coordinate, Coordinate]
    rx: tuple[Coordinate, Coordinate, Coordinate]
    value: Text
    quantity: Quantity = "path_loss"
    position: Literal["scene", "geographic"] = "scene"
    crs: Text | None = None
    position_unit: Annotated[float, Field(gt=0)] = 1.0
    where: Text | None = None
    weight: Text | None = None
    std: Coordinate | None = None
    tx_power_dbm: Coordinate | None = None
    eirp_dbm: Coordinate | None = None
    cable_loss_db: Coordinate | None = None
    tx_antenna: MountingSection | None = None
    rx_antenna: MountingSection | None = None
    device: Text | None = None
    position_error_m: Coordinate | None = None
    frequency: Text | None = None
    wide: dict[str, Text] = Field(default_factory=dict)
    track: TrackSection | None = None
    heights: Literal["ground"] | None = None
    transmitters: Text | None = None
    transmitter: Text = "transmitter"
    missing: tuple[float, ...] = ()
    noise_floor_dbm: float | None = None
    below_floor: Literal["exclude", "censor"] = "exclude"
    inside: Literal["keep", "drop", "move"] = "keep"
    average: _Average = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.position == "geographic" and self.position_unit != 1:
            raise InputError(
                f"links.position_unit = {self.position_unit:g} with position = 'geographic': degrees are not a unit of "
                "length; remove the key"
            )
        if self.crs is not None and (self.position != "geographic" or self.track is not None):
            raise InputError(
                f"links.crs = {self.crs!r}: applies only to geographic position columns; set links.position "
                "= 'geographic', and remove the track"
            )
        if self.eirp_dbm is not None and (self.tx_power_dbm is not None or self.cable_loss_db is not None):
            raise InputError(
                "links.eirp_dbm includes the transmitted power, the cable loss and the antenna gain; remove "
                "tx_power_dbm and cable_loss_db"
            )
        if self.cable_loss_db is not None and self.tx_power_dbm is None:
            raise InputError(
                "links.cable_loss_db needs tx_power_dbm [dBm], the power at the input of the cable"
            )
        if self.noise_floor_dbm is not None and self.quantity not in ("received_power", "rsrp"):
            raise InputError(
                f"links.noise_floor_dbm = {self.noise_floor_dbm:g} with quantity = {self.quantity!r}: the noise floor "
                "is a received power; filter path losses with links.where"
            )
        if self.below_floor == "censor" and self.noise_floor_dbm is None:
            raise InputError(
                "links.below_floor = 'censor' needs noise_floor_dbm [dBm], below which links are censored"
            )
        if self.below_floor == "censor" and self.average is not None:
            raise InputError(
                "links.below_floor = 'censor' with [links.average]: averages already include samples below the noise "
                "floor, as half the power of the floor; remove one of these keys"
            )
        return self

    @property
    def mountings(self) -> dict[str, MountingSection]:
        """The sections of the ends ("tx" and "rx") at which antennas differ between links."""
        stated = {"tx": self.tx_antenna, "rx": self.rx_antenna}
        return {end: section for end, section in stated.items() if section is not None}


class AntennasSection(Section):
    """``[antennas]``: the antennas at both ends.

    Attributes:
        tx: The transmit antenna.
        rx: The receive antenna.
        types: Further antennas by name, for ``links.tx_antenna.type`` and ``links.rx_antenna.type``.
        known: Whether an engine that exports rays used these antennas. By default, isotropic vertical antennas at both
            ends count as unknown, because a draft assumes such antennas.
    """

    tx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    rx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    types: dict[str, _Antenna] = Field(default_factory=dict)  # type: ignore[valid-type]
    known: bool | None = None
