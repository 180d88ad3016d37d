"""The paths of a loaded result whose engine is a program that returns rays."""

from __future__ import annotations

from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibray.engines import Ledger, fingerprint
from calibray.engines.ledger.database import key
from calibray.engines.rays.export import Export
from calibray.errors import InputError
from calibray.result.record import Record
from calibray.study import Setup

R = TypeVar("R", bound=Record)


def with_stored_paths(result: R, ledger: Path) -> R:
    """A result with the paths in its ledger, from the call at the calibrated or otherwise at the initial values.

    The result is unchanged if its engine returns no rays, the study can no longer be opened, or its scene and links do
    not belong to a call in the ledger.
    """
    if not result.study.engine.exports_rays or result.paths is not None or not ledger.is_file():
        return result
    with suppress(InputError):
        setup = Setup.open(result.study)
        calibrated = np.array([result.parameters[name] for name in setup.parameters.names])
        with closing(Ledger(ledger)) as store:
            for values in (calibrated, setup.parameters.start):
                entry = store.find(fingerprint(setup), key(values), len(setup.links))
                if entry is not None and not entry.failure:
                    materials = setup.parameters.materials(values, setup.scene.materials)
                    study = replace(setup, scene=replace(setup.scene, materials=materials))
                    return replace(result, paths=Export.of(study, entry.rays).paths)
    return result
