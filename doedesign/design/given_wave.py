"""How much light is in a wave whose amplitude and phase were asked for."""

from typing import NamedTuple

import numpy as np


class WaveShare(NamedTuple):
    """Light in a wave that is given but for a common phase.

    Attributes:
        share: of the incident light, that in the wave.
        ceiling: the largest share of a DOE of any phase: all of its cells in step (triangle inequality).
        phase_rmse: root mean square of the phase less the given one, radians, after the best common phase.
    """

    share: float
    ceiling: float
    phase_rmse: float

    def summary(self) -> dict[str, float]:
        """All numbers, for metrics."""
        return {"in_wave": self.share, "in_wave_ceiling": self.ceiling, "phase_rmse_rad": self.phase_rmse}

    def __str__(self) -> str:
        """Return "3.9 % (ceiling: 7.7 %) in the wave that is given, whose phase is off by 1 deg"."""
        share = f"{100 * self.share:.2f} % (ceiling: {100 * self.ceiling:.2f} %)"
        return f"{share} in the wave that is given, whose phase is off by {np.degrees(self.phase_rmse):.2g} deg"
