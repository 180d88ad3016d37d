"""The sections of a study file that state the scene, the links and the antennas; unknown keys are errors."""

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
        bandwidth: Bandwidth [Hz], for averaging over the band.
        origin: Longitude and latitude [deg] of the scene's origin, for geographic positions.
        crs: Projection of the scene's x and y, for instance "EPSG:32632"; a local projection at the origin if absent.
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
    """``[materials]``, one entry: constants that replace the scene's.

    Attributes:
        itu: ITU-R P.2040 material that gives permittivity and conductivity.
        revision: Revision of ITU-R P.2040; only with `itu`.
        relative_permittivity: Real part of the relative permittivity [1].
        conductivity: Conductivity [S/m].
        thickness: Thickness [m].
        scattering_coefficient: Scattering coefficient [1]; unlike a scene's value of 0, a stated 0 is exact.
        xpd_coefficient: Cross-polarization discrimination coefficient [1].
        scattering_pattern: "lambertian", "directive" or "backscattering".
        alpha_r: Exponent [1] of the lobe around the specular direction.
        alpha_i: Exponent [1] of the lobe back towards the source.
        lambda_: Share [1] of the diffuse energy in the lobe around the specular direction.
        roughness_mm: Standard deviation of the surface height [mm]; it weakens specular reflections.
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
                f"revision = {self.revision!r} without itu; name the ITU-R material, or remove it"
            )
        stated = self.model_dump(exclude_none=True, exclude={"itu", "revision", "roughness_mm"})
        Material(**{"relative_permittivity": 1.0, "conductivity": 0.0, "thickness": 1.0, **stated})
        return self


class AverageSection(Section):
    """``[links.average]``: samples that are close together are averaged into one link, in linear power.

    Attributes:
        by: "place" averages over equal receiver positions, "cell" over cells of a square grid, "distance" over the
            distance travelled in the order of the rows, and "time" over time windows.
        size: Width or length [m], or duration [s]; required except for "place".
        time: Column of times; only for "time".
        unbiased: Whether to correct the bias of the logarithm of a mean of few samples.
        minimum_count: Smallest number of samples in an average; averages of fewer samples are left out.
    """

    by: Literal["place", "cell", "distance", "time"]
    size: Annotated[float, Field(gt=0)] | None = None
    time: Text | None = None
    unbiased: bool = False
    minimum_count: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _sized_or_timed(self) -> Self:
        if (self.by == "place") != (self.size is None):
            remedy = "takes no size; remove it" if self.by == "place" else "needs size, in m or s"
            raise InputError(f"links.average: by = {self.by!r} {remedy}")
        if (self.by == "time") != (self.time is not None):
            remedy = "needs time, the column of times" if self.by == "time" else "takes no time; remove it"
            raise InputError(f"links.average: by = {self.by!r} {remedy}")
        return self


def _section_of_place(value: Any) -> Any:
    """``average = "place"`` is short for ``average = { by = "place" }``."""
    return {"by": "place"} if value == "place" else value


_Average = Annotated[
    AverageSection | None,
    BeforeValidator(_section_of_place, json_schema_input_type=AverageSection | Literal["place"] | None),
]


class TrackSection(Section):
    """``[links.track]``: a GPX track that gives the position of each row by its time.

    Attributes:
        file: GPX file, relative to the study file's folder.
        time: Column of the rows' times: ISO 8601, or seconds since 1970.
        longest_gap: Longest time between two track points [s]; rows in a longer gap are left out.
        clock: Time by which the table's clock is ahead of the track's clock [s].
    """

    file: Text
    time: Text
    longest_gap: Annotated[float, Field(gt=0)] = 10.0
    clock: float = 0.0


class MountingSection(Section):
    """``[links.tx_antenna]`` or ``[links.rx_antenna]``: the antenna of each link at this end, and its direction.

    Attributes:
        type: Column with names from ``[antennas.types]``; if absent, all links have the antenna of ``[antennas]``.
        azimuth_deg: Azimuth [deg], a number or a column; along x if absent. It rotates the antenna in
            addition to the antenna's own orientation.
        azimuth_from: "north" for compass bearings (clockwise from y), "east" for angles counter-clockwise from x.
        downtilt_deg: Mechanical downtilt [deg], a number or a column.
        electrical_downtilt_deg: Downward shift of the pattern in the antenna's frame, or of an array's beam [deg], a
            number or a column.
        steering_deg: Direction to which an array's beam is steered electrically, relative to the antenna [deg], a
            number or a column; clockwise if azimuths are compass bearings.
        aim: "other end" points every antenna at the other end of its link, in place of azimuth and downtilt.
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
                "aim = 'other end' gives azimuth and downtilt; remove azimuth_deg and downtilt_deg"
            )
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the links that this section names."""
        stated = (
            self.type,
            self.azimuth_deg,
            self.downtilt_deg,
            self.electrical_downtilt_deg,
            self.steering_deg,
        )
        return tuple(name for name in stated if isinstance(name, str))


class LinksSection(Section):
    """``[links]``: the table of measured links, and how its rows become links.

    Attributes:
        file: CSV, Parquet or Excel file, relative to the study file's folder.
        tx: Transmitter position (x, y, z) [m], each a number or a column; longitude, latitude [deg] and height [m]
            if positions are "geographic".
        rx: Receiver position, in the same form.
        value: Column of the measured values.
        quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm], a received power with
            unknown transmitted power.
        position: "scene" for metres in the scene's frame, "geographic" for longitude and latitude.
        crs: Reference system of positions that are "geographic", such as EPSG:32632; longitude and latitude if absent.
        position_unit: Unit of the position columns in the scene's frame [m].
        where: Row filter.
        weight: Column of relative weights [1].
        std: Standard deviation [dB] of the values, a number or a column.
        tx_power_dbm: Transmitted power [dBm], a number or a column; needed with a received power.
        eirp_dbm: Radiated power [dBm] in the main direction, in place of the transmitted power.
        cable_loss_db: Loss between transmitter and antenna [dB], a number or a column; needs a transmitted power.
        tx_antenna: Antennas of the transmitters, if they differ.
        rx_antenna: Antennas of the receivers, if they differ.
        device: Column of the names of receiving devices, which parameters such as "rx:PHONE.dx" displace.
        position_error_m: Standard deviation of receiver position errors along x and y [m], a number or a column.
        frequency: Column of carrier frequencies, in Hz or the unit in its name; if absent, all links have the scene's
            carrier.
        wide: Name of the transmitter by column, for a table with one column per transmitter.
        track: GPX track that gives each row the columns `track_longitude` and `track_latitude` [deg].
        heights: "ground" for heights above the scene's ground; above the datum of the scene's frame if absent.
        transmitters: Table with one row per transmitter, relative to the study file's folder.
        transmitter: Column of both tables with the name of the transmitter.
        missing: Numbers that mean that nothing was measured, in addition to common codes such as 100 or -999.
        noise_floor_dbm: Noise floor [dBm]; a missing received power counts as below it.
        below_floor: How rows at or below the noise floor are treated: "exclude" leaves them out, and "censor" keeps
            them as upper bounds of the received power, which the intervals account for.
        inside: How receivers inside buildings are treated: "keep", "drop", or "move" to the nearest street.
        average: How samples are averaged.
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
                f"links.position_unit = {self.position_unit:g} with position = 'geographic': degrees have no length; "
                f"remove it"
            )
        if self.crs is not None and (self.position != "geographic" or self.track is not None):
            raise InputError(
                f"links.crs = {self.crs!r}: is the reference system of columns of positions on the globe; set "
                "links.position = 'geographic', without a track"
            )
        if self.eirp_dbm is not None and (self.tx_power_dbm is not None or self.cable_loss_db is not None):
            raise InputError(
                "links.eirp_dbm includes the transmitted power, cables and the antenna's gain; remove tx_power_dbm and "
                "cable_loss_db"
            )
        if self.cable_loss_db is not None and self.tx_power_dbm is None:
            raise InputError("links.cable_loss_db needs tx_power_dbm [dBm], the power before the cable")
        if self.noise_floor_dbm is not None and self.quantity not in ("received_power", "rsrp"):
            raise InputError(
                f"links.noise_floor_dbm = {self.noise_floor_dbm:g} with quantity = {self.quantity!r}: the noise floor "
                "is a received power; filter losses by links.where"
            )
        if self.below_floor == "censor" and self.noise_floor_dbm is None:
            raise InputError(
                "links.below_floor = 'censor' needs noise_floor_dbm [dBm], the floor at which links are censored"
            )
        if self.below_floor == "censor" and self.average is not None:
            raise InputError(
                "links.below_floor = 'censor' with [links.average]: averages already count samples below the noise "
                "floor at half of the floor; remove one of them"
            )
        return self

    @property
    def mountings(self) -> dict[str, MountingSection]:
        """The sections of the ends, "tx" and "rx", whose antennas differ between links."""
        stated = {"tx": self.tx_antenna, "rx": self.rx_antenna}
        return {end: section for end, section in stated.items() if section is not None}


class AntennasSection(Section):
    """``[antennas]``: the antennas at both ends.

    Attributes:
        tx: The transmit antenna.
        rx: The receive antenna.
        types: Further antennas by name, for ``links.tx_antenna.type`` and ``links.rx_antenna.type``.
        known: Whether an engine that exports rays used these antennas. By default, isotropic vertical antennas at both
            ends, which a draft assumes, count as unknown.
    """

    tx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    rx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    types: dict[str, _Antenna] = Field(default_factory=dict)  # type: ignore[valid-type]
    known: bool | None = None
