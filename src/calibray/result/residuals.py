"""What the errors of neighbouring links share: what predictions beside measured links are corrected by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ResidualField:
    """Errors of which neighbours share a part; see `calibray.prediction.residual_field`.

    Attributes:
        range_m: Distance at which the shared part has fallen to 1/e [m].
        shared_db: Standard deviation of the shared part [dB].
        own_db: Standard deviation of each link's own part [dB].
    """

    range_m: float
    shared_db: float
    own_db: float
