"""Numbers that a DOE and its PSFs are judged by, each with its definition, and the one table of them (`METRICS`).

None changes a PSF's energy. `jax.grad`, `jit` and `vmap` go through all but the energy budget.

measures      of a PSF: energy within discs, far spot, ring:disc ratio, concentration
transmission  of the field behind a DOE: mean transmission, 0th order, Strehl ratio
budget        where all of the light goes
table         the table of metrics, and its rows for a DOE and its PSFs
"""

from sim.metrics.budget import EnergyBudget, energy_budget
from sim.metrics.measures import (
    RingToDisc,
    airy_radius_m,
    disc_radius_m,
    disc_weights,
    encircled_energy,
    energy_within,
    far_spot,
    mean_wavelength_m,
    near_and_far,
    participation,
    radius_map_m,
    ring_to_disc,
    spot_radius_m,
)
from sim.metrics.table import METRICS, Metric, MetricInputs, metric_rows, without_infinities
from sim.metrics.transmission import cell_optic_of, in_parts, mean_transmission, opening, strehl, zeroth_order

__all__ = [
    "METRICS",
    "EnergyBudget",
    "Metric",
    "MetricInputs",
    "RingToDisc",
    "airy_radius_m",
    "cell_optic_of",
    "disc_radius_m",
    "disc_weights",
    "encircled_energy",
    "energy_budget",
    "energy_within",
    "far_spot",
    "in_parts",
    "mean_transmission",
    "mean_wavelength_m",
    "metric_rows",
    "near_and_far",
    "opening",
    "participation",
    "radius_map_m",
    "ring_to_disc",
    "spot_radius_m",
    "strehl",
    "without_infinities",
    "zeroth_order",
]
