"""The sections of a study file that define the calibration. Unknown keys in these sections are errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from math import isfinite
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from calibray.errors import InputError
from calibray.parameters import Scale, itu_start
from calibray.scenes.obstruction import CLUSTER
from calibray.support.messages import did_you_mean, shortened
from calibray.support.strict_models import Section, Text


class ObjectiveSection(Section):
    """``[objective]``: how path loss is computed from the paths, and how links without a path are treated.

    Attributes:
        combining: "power" (sum of path powers), "coherent" (sum of fields) or "band" (coherent power averaged
            over the bandwidth).
        no_path: "exclude" omits links without a path from the objective; "censor" sets their modelled path loss to
            `ceiling_db`.
        ceiling_db: Largest measurable path loss [dB]; allowed only with "censor".
    """

    combining: Literal["power", "coherent", "band"] = "power"
    no_path: Literal["exclude", "censor"] = "exclude"
    ceiling_db: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _ceiling_only_with_censor(self) -> Self:
        if self.no_path == "censor" and self.ceiling_db is None:
            raise InputError("no_path = 'censor' needs ceiling_db [dB], the largest measurable path loss")
        if self.no_path == "exclude" and self.ceiling_db is not None:
            raise InputError(
                f"ceiling_db = {self.ceiling_db:g} has no effect; set no_path = 'censor' or remove ceiling_db"
            )
        return self


class PriorSection(Section):
    """The prior of a parameter: log-normal around a value or another parameter, or Gaussian around the start value.

    Attributes:
        itu: Name of the ITU-R P.2040 material on whose value the prior is centred, with or without "@REVISION".
        value: Value on which the prior is centred, in the unit of the parameter; an alternative to `itu`.
        like: Name of another parameter on whose value the prior is centred; an alternative to `itu`. Both parameters
            are then members of the same population.
        spread: Standard deviation of the natural logarithm of the parameter; 0.3 corresponds to about 30 %.
        std: Standard deviation of a Gaussian prior around the start value, in the unit of the parameter. This key
            replaces `itu`, `value`, `like` and `spread`.
        shared: Whether `std` is the standard deviation across a population of transmitters. This standard deviation is
            estimated if the `spread` of the parameter is "auto".
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
                    "a prior with std is Gaussian around the start value: remove itu, value, like and spread"
                )
            return self
        if self.spread is None:
            raise InputError("a prior needs spread (the standard deviation of the logarithm) or std")
        if sum(stated is not None for stated in (self.itu, self.value, self.like)) != 1:
            raise InputError(
                "a prior is centred on an ITU material, a value or another parameter: give exactly one of itu, value "
                "and like"
            )
        return self


class ParameterSection(Section):
    """One entry of ``[parameters]``: bounds, start value and scale of a parameter.

    Attributes:
        bounds: Lower and upper bounds, in the unit of the parameter.
        start: Value before calibration: a number, "itu:NAME" or "itu:NAME@REVISION". If absent, the value in the scene
            is used.
        scale: "linear" or "log".
        prior: Prior of the parameter; uniform within the bounds if absent.
        spread: Standard deviation across transmitters of a parameter such as "tx:*.azimuth", in the unit of the
            parameter; "auto" estimates this standard deviation. If absent, only the value common to all transmitters is
            calibrated.
    """

    bounds: tuple[float, float]
    start: float | str | None = None
    scale: Scale = "linear"
    prior: PriorSection | None = None
    spread: Literal["auto"] | Annotated[float, Field(gt=0)] | None = None

    def centre(self, name: str, frequency: float) -> float:
        """The centre of the prior at a carrier [Hz], in the parameter's unit; 1 if the centre is another parameter.

        Raises:
            InputError: The parameter has no prior, ITU-R P.2040 does not specify the constant, or either the prior
                value or the lower bound is not positive.
        """
        if self.prior is None:
            raise InputError(f"{name}: has no prior")
        value = self.prior.value if self.prior.like is None else 1.0
        if value is None:
            value = itu_start(name, f"itu:{self.prior.itu}", frequency, "prior.itu")
        if not min(value, self.bounds[0]) > 0:
            raise InputError(
                f"{name}: a log-normal prior needs a positive value and a positive lower bound, but they are "
                f"{value:g} and {self.bounds[0]:g}"
            )
        return value


def _ordered(value: tuple[float, float] | None) -> tuple[float, float] | None:
    if value is not None and value[0] >= value[1]:
        raise InputError("the lower bound must be less than the upper bound")
    return value


@dataclass(frozen=True)
class NuisanceTerm:
    """A column of the links, multiplied by an unknown coefficient: one for all links, or one per group.

    Attributes:
        by: "constant", "log_distance" (decades of distance), a column computed from the scene ("out_of_sight",
            "walls_crossed", "obstruction_m", "knife_edge_db", "region_m", "clutter_db"), or a numeric column of the
            links.
        per: Columns whose joined labels define the groups. If empty, there is one coefficient for all links.
        bounds: Lower and upper bounds of the coefficient, in dB per unit of the column; unbounded if None.
        prior: Standard deviation of a Gaussian prior around zero, in the same unit. The prior is flat if None. With
            "auto", the prior is centred on the mean of the groups and its standard deviation is estimated.
    """

    by: str
    per: tuple[str, ...]
    bounds: tuple[float, float] | None
    prior: float | Literal["auto"] | None


class OffsetSection(Section):
    """``[offset]``: the nuisance term "offset" [dB], one value for all links or one per group.

    Attributes:
        per: Column of group labels, or several columns whose labels are joined. If absent, all links share one offset.
        bounds: Lower and upper bounds [dB] of the offset; unbounded if absent.
        prior_db: Standard deviation [dB] of a Gaussian prior around zero. If absent, the prior is flat.
    """

    per: Text | tuple[Text, ...] | None = None
    bounds: tuple[float, float] | None = None
    prior_db: Annotated[float, Field(gt=0)] | None = None

    _ordered = field_validator("bounds")(_ordered)

    def term(self) -> NuisanceTerm:
        """The nuisance term that this section defines."""
        per = (self.per,) if isinstance(self.per, str) else self.per or ()
        return NuisanceTerm("constant", per, self.bounds, self.prior_db)


OFFSET: Final = "offset"
"""Name of the nuisance term that ``[offset]`` defines."""

FREE_OFFSET: Final = "free offset"
"""Name of the nuisance term that tests for an undeclared offset."""

TX_OFFSET: Final = "offset of the transmitter"
"""Name of the nuisance term with one offset per transmitter, used in predictions."""

OF_ALL_LINKS: Final = " of all links"
"""Suffix of the names of nuisance terms that predictions add, each with one coefficient for all links."""


class NuisanceSection(Section):
    """``[nuisance.NAME]``: a column of the links, multiplied by an unknown coefficient for all links or for each group.

    Attributes:
        by: "constant", "log_distance" (decades of distance), a column computed from the scene ("out_of_sight",
            "walls_crossed", "obstruction_m", "knife_edge_db", "region_m", "clutter_db"), or a numeric column of the
            links.
        per: Column of group labels. If absent, there is one coefficient for all links. With `cluster_m`, "cluster" is
            computed from the receiver positions and need not be a column.
        cluster_m: Side length [m] of the squares into which receivers are grouped if `per` is "cluster".
        bounds: Lower and upper bounds of the coefficient, in dB per unit of the column; unbounded if absent.
        prior: Standard deviation of a Gaussian prior around zero, in the same unit. If absent, the prior is flat. With
            "auto", the prior is centred on the mean of the groups and its standard deviation is estimated (a random
            effect).
    """

    by: Text
    per: Text | None = None
    cluster_m: Annotated[float, Field(gt=0)] | None = None
    bounds: tuple[float, float] | None = None
    prior: Literal["auto"] | Annotated[float, Field(gt=0)] | None = None

    _ordered = field_validator("bounds")(_ordered)

    @model_validator(mode="after")
    def _random_effect(self) -> Self:
        if self.prior == "auto" and (self.per is None or self.bounds is not None):
            raise InputError(
                "prior = 'auto' needs per, the column of the groups, and cannot be combined with bounds"
            )
        if self.cluster_m is not None and self.per != CLUSTER:
            raise InputError(f"cluster_m, the side length of the squares, needs per = {CLUSTER!r}")
        return self

    def term(self) -> NuisanceTerm:
        """The nuisance term."""
        return NuisanceTerm(self.by, () if self.per is None else (self.per,), self.bounds, self.prior)


class NoiseSection(Section):
    """``[noise]``: the errors of the measured links.

    Attributes:
        std_db: Standard deviation [dB] of the error of a link; it determines the weight of the priors relative to the
            measurements. If absent, it is estimated.
        kind: Distribution of the errors: "gaussian", "student-t", or "auto" for intervals that account for both
            distributions.
        range_m: Correlation distance [m] of the errors of neighbouring links; 0 for no correlation, or "auto".
        heterogeneity: Spread of a material's constants between buildings; 0 for no spread, or "auto".
        constants_spread: Spread of the fixed constants (thickness, conductivity, scattering coefficient) of a
            calibrated material, as the standard deviation of the logarithm. State 0 if the values in the scene are
            exact. A scattering coefficient of 0 has a separate prior, unless `constants_spread` is 0.
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
                f"noise: {' and '.join(stated)}: only one of these can be stated; leave the others at 'auto'"
            )
        return self


DEFAULT_BLOCKS: Final = 4
"""Default number of spatial blocks, each of which is held out in turn."""

MOST_BLOCKS: Final = 100
"""Maximum number of spatial blocks. Each block requires a calibration."""


class HoldoutSection(Section):
    """``[holdout]``: links that are held out to test the result, selected in one of three ways.

    Attributes:
        where: Row filter that selects the held-out links.
        blocks: Number of spatial blocks, each held out in turn.
        by: Column of labels; all links with the same label are held out together.
    """

    where: Text | None = None
    blocks: Annotated[int, Field(ge=2, le=MOST_BLOCKS)] | None = None
    by: Text | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if sum(way is not None for way in (self.where, self.blocks, self.by)) != 1:
            raise InputError("holdout: give exactly one of where, blocks and by")
        return self


class FidelitySection(Section):
    """``[fidelity]``: repeated tracing with the calibrated materials, because the paths can depend on the materials.

    Attributes:
        tolerance_db: Largest accepted change [dB] in the path loss of a link.
        rounds: Maximum number of further traces. The default is 3, or 4 if positions are parameters.
    """

    tolerance_db: Annotated[float, Field(gt=0)] = 0.5
    rounds: Annotated[int, Field(ge=0, le=100)] | None = None


class MethodSection(Section):
    """``[method]``: the optimizer.

    Attributes:
        name: "auto", "sgwo-im", "gwo" or another registered method.
        seed: Seed of the method's random number generator.
        model: Cheap approximation of an expensive engine: "replay" of the study's scene, or "none".
        options: Settings of the method `name`.
    """

    name: Text = "auto"
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    model: Literal["replay", "none"] = "replay"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        check_options(self.name, self.options)
        return self


LARGEST: Final = 10**6
"""Maximum integer value of a setting, because no method can hold more candidates in memory."""

LONGEST: Final = 10**4
"""Maximum number of entries in a list, and of characters in a string."""

_TYPES: Final[Mapping[str, tuple[tuple[type, ...], str]]] = {
    "bool": ((bool,), "true or false"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a number"),
    "str": ((str,), "text in quotes"),
}


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Check the names, types and sizes of a method's settings; the method itself checks the values.

    If the method is unknown or is chosen later, only the sizes are checked.

    Raises:
        InputError: A setting is unknown, of the wrong type, not finite or too large. The message begins with the key of
            the setting.
    """
    if not options:
        return
    # Optimizers import SciPy, which is not needed for a study without method options.
    from calibray.optimizers import METHODS, NO_OPTIONS

    settings = None
    if name in METHODS:
        arguments = signature(METHODS[name]).parameters
        settings = {key: argument for key, argument in arguments.items() if key not in NO_OPTIONS}
    for key, value in options.items():
        prefix = f"method.options.{shortened(key)}"
        if settings is not None and key not in settings:
            raise InputError(
                f"{prefix}: the method {name!r} has no such setting; {did_you_mean(key, settings)}"
            )
        prefix += f" = {shortened(repr(value))}"
        _check_size(prefix, value)
        if settings is not None:
            _check_type(prefix, settings[key], value)


def _check_type(prefix: str, argument: Parameter, value: Any) -> None:
    """Check a value against the annotated type of its argument; types missing from `_TYPES` are not checked."""
    types = [part.strip() for part in str(argument.annotation).split("|")]
    if not set(types) - {"None"} <= set(_TYPES):
        return
    for name in types:
        allowed, _ = _TYPES.get(name, ((), ""))
        # In Python, True and False are also integers.
        if isinstance(value, allowed) and (isinstance(value, bool) == (name == "bool")):
            return
    wanted = " or ".join(_TYPES[name][1] for name in types if name in _TYPES)
    raise InputError(f"{prefix}: must be {wanted}")


def _check_size(prefix: str, value: Any, depth: int = 2) -> None:
    match value:
        case bool():
            pass
        case int() if abs(value) > LARGEST:
            raise InputError(f"{prefix}: must be at most {LARGEST:,}")
        case float() if not isfinite(value):
            raise InputError(f"{prefix}: must be a finite number")
        case str() if len(value) > LONGEST:
            raise InputError(f"{prefix}: must have at most {LONGEST:,} characters")
        case list() | tuple() if depth and len(value) <= LONGEST:
            for entry in value:
                _check_size(prefix, entry, depth - 1)
        case list() | tuple():
            raise InputError(f"{prefix}: must be a list of at most {LONGEST:,} entries, nested at most once")
        case int() | float() | str():
            pass
        case _:
            raise InputError(f"{prefix}: must be a number, text, true, false, or a list of these")
