"""Matter by the material point method (MLS-MPM with APIC transfers): make a model, a rest state, and advance it."""

from drgs.deform.matter.mpm.advance import AdvanceReport, advance
from drgs.deform.matter.mpm.diagnostics import Balance, energy_density, measure_balance
from drgs.deform.matter.mpm.records import (
    LAWS,
    Box,
    Condition,
    GridSettings,
    Material,
    Model,
    MpmSettings,
    Plane,
    Solid,
    Sphere,
    State,
    make_model,
    rest_state,
)

__all__ = [
    "LAWS",
    "AdvanceReport",
    "Balance",
    "Box",
    "Condition",
    "GridSettings",
    "Material",
    "Model",
    "MpmSettings",
    "Plane",
    "Solid",
    "Sphere",
    "State",
    "advance",
    "energy_density",
    "make_model",
    "measure_balance",
    "rest_state",
]
