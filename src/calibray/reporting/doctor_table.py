"""The diagnosis of a machine as a table."""

from __future__ import annotations

from calibray.doctor import Diagnosis
from calibray.tables import Column, Table


def table(diagnosis: Diagnosis) -> Table:
    """All that was found, what to do, and a verdict.

    Args:
        diagnosis: What `calibray.doctor.examine` found.

    Returns:
        A table of two columns without headings.
    """
    works = "Calibray works here" if diagnosis.usable else "Calibray cannot trace and replay here"
    rows = [
        *diagnosis.versions,
        ("Mitsuba variant", diagnosis.variant),
        ("GPUs for tracing", str(diagnosis.cuda_devices)),
        *(
            (f"libLLVM {each.label}", f"{each.path}, {each.problem or 'usable'}")
            for each in diagnosis.libraries
        ),
        *(
            (check.name, f"{'ok' if check.passed else 'FAILED'}, {check.detail}")
            for check in diagnosis.checks
        ),
        *(("To do", check.remedy) for check in diagnosis.checks if not check.passed),
        ("Verdict", works),
    ]
    return Table("", (Column(), Column()), tuple(rows))
