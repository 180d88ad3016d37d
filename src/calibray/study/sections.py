"""The sections of a study file, each a closed model: an unknown key is an error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic.dataclasses import dataclass as checked

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import FREQUENCIES, Quantity
from calibray.parameters import Scale, itu_start
from calibray.study.method_options import check_options
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
        bandwidth: Bandwidth [Hz], for combining over the band.
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
            raise InputError(f"must be in {lowest:g} to {highest:g} Hz; 28.5 GHz is written 28.5e9")
        return value


class MaterialSection(Section):
    """``[materials]``, one entry: constants in place of the scene's.

    Attributes:
        itu: ITU-R P.2040 material that gives permittivity and conductivity.
        revision: Revision of ITU-R P.2040, with `itu` only.
        relative_permittivity: Real part of the relative permittivity [1].
        conductivity: Conductivity [S/m].
        thickness: Thickness [m].
        scattering_coefficient: Scattering coefficient [1].
        xpd_coefficient: Cross-polarization discrimination coefficient [1].
        scattering_pattern: "lambertian", "directive" or "backscattering".
        alpha_r: Exponent [1] of the lobe around the specular direction.
        alpha_i: Exponent [1] of the lobe back towards the source.
        lambda_: Share [1] of the diffuse energy in the lobe around the specular direction.
        roughness_mm: Standard deviation of the heights of the surface [mm], which weakens specular reflections.
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
                f"revision = {self.revision!r} without itu; name the ITU-R material, or leave it out"
            )
        stated = self.model_dump(exclude_none=True, exclude={"itu", "revision", "roughness_mm"})
        Material(**{"relative_permittivity": 1.0, "conductivity": 0.0, "thickness": 1.0, **stated})
        return self


class AverageSection(Section):
    """``[links.average]``: samples close together are averaged to one link, in linear power.

    Attributes:
        by: "place" of equal receiver positions, "cell" of a square grid, "distance" travelled in the order of the
            rows, or window of "time".
        size: Width or length [m], or duration [s]; required except for "place".
        time: Column of times, for "time" only.
        unbiased: Whether to correct the bias of the logarithm of a mean of few samples.
        minimum_count: Averages of fewer samples are left out.
    """

    by: Literal["place", "cell", "distance", "time"]
    size: Annotated[float, Field(gt=0)] | None = None
    time: Text | None = None
    unbiased: bool = False
    minimum_count: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _sized(self) -> Self:
        if (self.by == "place") != (self.size is None):
            remedy = "takes no size; leave it out" if self.by == "place" else "needs size, in m or s"
            raise InputError(f"links.average: by = {self.by!r} {remedy}")
        return self

    @model_validator(mode="after")
    def _timed(self) -> Self:
        if (self.by == "time") != (self.time is not None):
            remedy = "needs time, the column of times" if self.by == "time" else "takes no time; leave it out"
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
        longest_gap: Longest time between two points of the track [s]; rows in a longer gap are left out.
        clock: How much the table's clock is ahead of the track's [s].
    """

    file: Text
    time: Text
    longest_gap: Annotated[float, Field(gt=0)] = 10.0
    clock: float = 0.0


class MountingSection(Section):
    """``[links.tx_antenna]`` or ``[links.rx_antenna]``: which antenna each link has at this end, and where it points.

    Attributes:
        type: Column of names of ``[antennas.types]``; all have the antenna of ``[antennas]`` if absent.
        azimuth_deg: Azimuth [deg], a number or a column; along x if absent. It turns the antenna's own orientation.
        azimuth_from: "north" for compass bearings (clockwise from y), "east" for angles counter-clockwise from x.
        downtilt_deg: Mechanical downtilt [deg], a number or a column.
        electrical_downtilt_deg: Shift of the pattern downwards in the antenna's frame [deg], a number or a column; of
            the beam of an array.
        steering_deg: Direction to which an array's beam is turned electrically, relative to the antenna [deg], a number
            or a column; clockwise if azimuths are compass bearings.
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
                "aim = 'other end' gives azimuth and downtilt; leave azimuth_deg and downtilt_deg out"
            )
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the links that it names."""
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
        rx: Receiver position, likewise.
        value: Column of the measured values.
        quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm], a received power with
            unknown transmitted power.
        position: "scene" for metres in the scene's frame, "geographic" for longitude and latitude.
        crs: Reference system of positions that are "geographic", such as EPSG:32632; longitude and latitude if absent.
        position_unit: Length of one unit of position columns [m], in the scene's frame.
        where: Row filter.
        weight: Column of relative weights [1].
        std: Standard deviation [dB] of the values, a number or a column.
        eirp_dbm: Radiated power [dBm] in the main direction, in place of the transmitted power.
        cable_loss_db: Loss between transmitter and antenna [dB], a number or a column, with a transmitted power.
        tx_antenna: Antennas of the transmitters, if they differ.
        rx_antenna: Antennas of the receivers, if they differ.
        device: Column of the names of receiving devices, which parameters such as "rx:PHONE.dx" displace.
        device: Column of the names of receiving devices, which parameters such as "rx:PHONE.dx" displace.
        position_error_m: Standard deviation of the receivers' positions along x and y [m], a number or a column.
        frequency: Column of carrier frequencies [Hz]; if absent, all links have the scene's carrier.
        wide: Name of the transmitter by column, for a table with one column per transmitter.
        track: GPX track that gives each row the columns `track_longitude` and `track_latitude` [deg].
        heights: "ground" for heights above the scene's ground; above z = 0 of the scene if absent.
        transmitters: Table with one row per transmitter, relative to the study file's folder.
        transmitter: Column of both tables with the name of the transmitter.
        missing: Numbers that mean that nothing was measured, in addition to usual ones such as 100 or -999.
        noise_floor_dbm: Noise floor [dBm]; a missing received power counts as below it.
        below_floor: How rows at or below the noise floor are treated: "exclude" leaves them out, "censor" keeps them as
            upper bounds of the received power, which the intervals take into account.
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
    def _unit_of_lengths(self) -> Self:
        if self.position == "geographic" and self.position_unit != 1:
            raise InputError(
                f"links.position_unit = {self.position_unit:g} with position = 'geographic': degrees have no length; "
                "leave it out"
            )
        return self

    @model_validator(mode="after")
    def _place_on_the_globe(self) -> Self:
        if self.crs is not None and (self.position != "geographic" or self.track is not None):
            raise InputError(
                f"links.crs = {self.crs!r}: it is the reference system of columns with positions on the globe; set "
                "links.position = 'geographic', without a track"
            )
        return self

    @model_validator(mode="after")
    def _one_power(self) -> Self:
        if self.eirp_dbm is not None and (self.tx_power_dbm is not None or self.cable_loss_db is not None):
            raise InputError(
                "links.eirp_dbm includes the transmitted power, cables and the antenna's gain; leave tx_power_dbm and "
                "cable_loss_db out"
            )
        if self.cable_loss_db is not None and self.tx_power_dbm is None:
            raise InputError("links.cable_loss_db needs tx_power_dbm [dBm], the power before the cable")
        return self

    @property
    def mountings(self) -> dict[str, MountingSection]:
        """The ends, "tx" and "rx", whose antennas differ between links."""
        stated = {"tx": self.tx_antenna, "rx": self.rx_antenna}
        return {end: section for end, section in stated.items() if section is not None}

    @model_validator(mode="after")
    def _power_above_its_floor(self) -> Self:
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
                "links.below_floor = 'censor' with [links.average]: averages already count samples below the "
                "noise floor at half of the floor; leave one of them out"
            )
        return self


class AntennasSection(Section):
    """``[antennas]``: the antennas at both ends.

    Attributes:
        tx: The transmit antenna.
        rx: The receive antenna.
        types: Further antennas by name, for ``links.tx_antenna.type`` and ``links.rx_antenna.type``.
    """

    tx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    rx: _Antenna = Field(default_factory=_Antenna)  # type: ignore[valid-type]
    types: dict[str, _Antenna] = Field(default_factory=dict)  # type: ignore[valid-type]


class ObjectiveSection(Section):
    """``[objective]``: how paths combine to a path loss, and how a link without a path counts.

    Attributes:
        combining: "power" (sum of path powers), "coherent" (sum of fields) or "band" (coherent power averaged
            over the bandwidth).
        no_path: "exclude" leaves a link without a path out of the objective; "censor" counts it with
            `ceiling_db`.
        ceiling_db: Largest path loss that can be measured [dB], with "censor" only.
    """

    combining: Literal["power", "coherent", "band"] = "power"
    no_path: Literal["exclude", "censor"] = "exclude"
    ceiling_db: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _ceiling_only_with_censor(self) -> Self:
        if self.no_path == "censor" and self.ceiling_db is None:
            raise InputError(
                "no_path = 'censor' needs ceiling_db [dB], the largest loss that could be measured"
            )
        if self.no_path == "exclude" and self.ceiling_db is not None:
            raise InputError(
                f"ceiling_db = {self.ceiling_db:g} has no effect; set no_path = 'censor' or leave it out"
            )
        return self


class PriorSection(Section):
    """The prior of a parameter: log-normal around a value, or Gaussian around the start value.

    Attributes:
        itu: ITU-R P.2040 material that gives the value, with or without "@REVISION".
        value: The value itself, in the field's unit, in place of `itu`.
        like: Another parameter that this one scatters around, in place of `itu`: they are of one population.
        spread: Standard deviation of the logarithm: 0.3 is about 30 %.
        std: Standard deviation of a Gaussian prior around the start value, in the field's unit, in place of the others.
        shared: Whether `std` is the spread of a population of transmitters, which is estimated if theirs is "auto".
    """

    itu: Text | None = None
    value: Annotated[float, Field(gt=0)] | None = None
    like: Text | None = None
    spread: Annotated[float, Field(gt=0, le=10)] | None = None
    std: Annotated[float, Field(gt=0)] | None = None
    shared: bool = False

    @model_validator(mode="after")
    def _one_centre(self) -> Self:
        if self.std is not None:
            if any(stated is not None for stated in (self.itu, self.value, self.like, self.spread)):
                raise InputError(
                    "a prior with std is Gaussian around the start value: leave itu, value, like and spread out"
                )
            return self
        if self.spread is None:
            raise InputError("a prior needs spread, the standard deviation of its logarithm, or std")
        if sum(stated is not None for stated in (self.itu, self.value, self.like)) != 1:
            raise InputError(
                "a prior is centred on an ITU material, a value or another parameter: give one of itu, value and like"
            )
        return self


class ParameterSection(Section):
    """``[parameters]``, one entry: the bounds, start and scale of one parameter.

    Attributes:
        bounds: Lower and upper bound, in the field's unit.
        start: Value before calibration, a number, "itu:NAME" or "itu:NAME@REVISION"; if absent, the scene's.
        scale: "linear" or "log".
        prior: Its prior; uniform within the bounds if absent.
        spread: Standard deviation, in the field's unit, of the values of single transmitters around the common one of a
            parameter such as "tx:*.azimuth", or "auto" to estimate it; if absent, only the common value is calibrated.
    """

    bounds: tuple[float, float]
    start: float | str | None = None
    scale: Scale = "linear"
    prior: PriorSection | None = None
    spread: Literal["auto"] | Annotated[float, Field(gt=0)] | None = None

    def centre(self, name: str, frequency: float) -> float:
        """The value that the prior is centred on, in the field's unit; 1 if it is like another parameter.

        Args:
            name: The parameter.
            frequency: The carrier [Hz].

        Raises:
            InputError: There is no prior, ITU-R P.2040 gives no such value, or a bound or the value is not positive.
        """
        if self.prior is None:
            raise InputError(f"{name}: has no prior")
        value = self.prior.value if self.prior.like is None else 1.0
        if value is None:
            value = itu_start(name, f"itu:{self.prior.itu}", frequency)
        if not min(value, self.bounds[0]) > 0:
            raise InputError(
                f"{name}: a log-normal prior needs a positive value and lower bound, but they are {value:g} and "
                f"{self.bounds[0]:g}"
            )
        return value


def _ordered(value: tuple[float, float] | None) -> tuple[float, float] | None:
    if value is not None and value[0] >= value[1]:
        raise InputError("the lower bound must be less than the upper")
    return value


@dataclass(frozen=True)
class NuisanceTerm:
    """A column of the links times an unknown coefficient, for all links or one per group.

    Attributes:
        by: "constant", "log_distance" (decades of distance), a column that follows from the scene ("out_of_sight",
            "walls_crossed", "obstruction_m", "knife_edge_db", "region_m", "clutter_db"), or a numeric column of the
            links.
        per: Columns whose joined labels are the groups; one coefficient for all links if there are none.
        bounds: Lower and upper bound of the coefficient, [dB] per unit of the column; unbounded if None.
        prior: Standard deviation of a Gaussian prior around zero, in the same unit; flat if None; "auto" around the
            mean of the groups, its standard deviation estimated.
    """

    by: str
    per: tuple[str, ...]
    bounds: tuple[float, float] | None
    prior: float | Literal["auto"] | None


class OffsetSection(Section):
    """``[offset]``: the nuisance term "offset", one [dB] for all links or one per group.

    Attributes:
        per: Column of group labels, or several columns whose labels are joined; one offset for all links if absent.
        bounds: Lower and upper bound [dB]; unbounded if absent.
        prior_db: Standard deviation of a Gaussian prior around zero [dB]; flat if absent.
    """

    per: Text | tuple[Text, ...] | None = None
    bounds: tuple[float, float] | None = None
    prior_db: Annotated[float, Field(gt=0)] | None = None

    _ordered = field_validator("bounds")(_ordered)

    def term(self) -> NuisanceTerm:
        """The nuisance term that this section is the short form of."""
        per = (self.per,) if isinstance(self.per, str) else self.per or ()
        return NuisanceTerm("constant", per, self.bounds, self.prior_db)


class NuisanceSection(Section):
    """``[nuisance.NAME]``: a column of the links times an unknown coefficient, for all links or one per group.

    Attributes:
        by: "constant", "log_distance" (decades of distance), a column that follows from the scene ("out_of_sight",
            "walls_crossed", "obstruction_m", "knife_edge_db", "region_m", "clutter_db"), or a numeric column of the
            links.
        per: Column of group labels; one coefficient for all links if absent.
        bounds: Lower and upper bound of the coefficient, [dB] per unit of the column; unbounded if absent.
        prior: Standard deviation of a Gaussian prior around zero, in the same unit; flat if absent. "auto" is a prior
            around the mean of the groups, whose standard deviation is estimated (a random effect).
    """

    by: Text
    per: Text | None = None
    bounds: tuple[float, float] | None = None
    prior: Literal["auto"] | Annotated[float, Field(gt=0)] | None = None

    _ordered = field_validator("bounds")(_ordered)

    @model_validator(mode="after")
    def _random_effect(self) -> Self:
        if self.prior == "auto" and (self.per is None or self.bounds is not None):
            raise InputError("prior = 'auto' needs per, the column of the groups, and no bounds")
        return self

    def term(self) -> NuisanceTerm:
        """The nuisance term."""
        return NuisanceTerm(self.by, () if self.per is None else (self.per,), self.bounds, self.prior)


class NoiseSection(Section):
    """``[noise]``: the errors of measured links.

    Attributes:
        std_db: Standard deviation of a link's error [dB], which weighs the priors; estimated if absent.
        kind: "gaussian", "student-t", or "auto" for intervals that cover both.
        range_m: Correlation distance of neighbouring links' errors [m], 0 for none, or "auto".
        heterogeneity: Between-building spread of a material's constants, 0 for none, or "auto".
        constants_spread: Standard deviation of the logarithm of thickness, conductivity and scattering coefficient of
            calibrated materials, where they are no parameters: how well the scene's values are known; 0 if exactly.
    """

    std_db: Annotated[float, Field(gt=0)] | None = None
    kind: Literal["auto", "gaussian", "student-t"] = "auto"
    range_m: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"
    heterogeneity: Literal["auto"] | Annotated[float, Field(ge=0, le=2)] = "auto"
    constants_spread: Annotated[float, Field(ge=0, le=2)] = 0.15

    @model_validator(mode="after")
    def _one_departure(self) -> Self:
        stated = []
        if self.kind == "student-t":
            stated.append("kind = 'student-t'")
        if self.range_m not in ("auto", 0):
            stated.append(f"range_m = {self.range_m}")
        if self.heterogeneity not in ("auto", 0):
            stated.append(f"heterogeneity = {self.heterogeneity}")
        if len(stated) > 1:
            raise InputError(
                f"noise: {' and '.join(stated)}: only one of them can be stated; leave the others at 'auto'"
            )
        return self


class HoldoutSection(Section):
    """``[holdout]``: links that are not calibrated on, for validation; chosen in one of three ways.

    Attributes:
        where: Row filter; links that pass it are held out.
        blocks: Number of spatial blocks, each held out in turn.
        by: Column of labels; the links of each label are held out in turn.
    """

    where: Text | None = None
    blocks: Annotated[int, Field(ge=2, le=100)] | None = None
    by: Text | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if sum(way is not None for way in (self.where, self.blocks, self.by)) != 1:
            raise InputError("holdout: give one of where, blocks and by")
        return self


class FidelitySection(Section):
    """``[fidelity]``: tracing again with the calibrated materials, because paths may depend on them.

    Attributes:
        tolerance_db: Largest change of a link's path loss [dB] that is accepted.
        rounds: Largest number of traces, 0 for none.
    """

    tolerance_db: Annotated[float, Field(gt=0)] = 0.5
    rounds: Annotated[int, Field(ge=0, le=100)] = 3


class MethodSection(Section):
    """``[method]``: the optimizer.

    Attributes:
        name: "auto", "sgwo-im", "gwo" or another registered method.
        seed: Seed of its random numbers.
        model: The cheap model of an expensive engine: "replay" of the study's scene, or "none".
        options: Settings of the named method.
    """

    name: Text = "auto"
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    model: Literal["replay", "none"] = "replay"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        check_options(self.name, self.options)
        return self
