"""Results with some fields changed, whatever section they are in."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from calibray.calibration.result import Result

SECTIONS = ("fit", "accuracy", "uncertainty", "nuisance", "prediction", "cost", "provenance")


def changed(result: Result, **values: Any) -> Result:
    """A result with other values; the prediction model has the same parameters, materials and nuisance.

    Args:
        result: The result.
        values: The values by field, of the result itself or of one of its sections.

    Returns:
        The changed result.
    """
    prediction = result.prediction
    model = prediction.model
    if "parameters" in values:
        model = replace(model, parameters=values["parameters"])
    if "coefficients" in values:
        coefficients = values["coefficients"]
        terms = [term for term in model.terms if coefficients.get(term.name)]
        terms = [replace(term, coefficients=coefficients[term.name]) for term in terms]
        model = replace(model, terms=tuple(terms))
    materials = values.get("materials", prediction.materials)
    result = replace(result, prediction=replace(prediction, model=model, materials=materials))
    for section in SECTIONS:
        part = getattr(result, section)
        names = {field.name for field in fields(part)} & set(values)
        if names:
            result = replace(result, **{section: replace(part, **{name: values.pop(name) for name in names})})
    return replace(result, **values)
