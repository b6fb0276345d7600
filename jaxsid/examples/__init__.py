"""Reference systems, their excitation and their records, simulated without the library's own simulator."""

from jaxsid.examples.excitation import chirp, stepped_sine
from jaxsid.examples.structures import chain, galileo, mini_mast, railway_vehicle, turbine_generator
from jaxsid.examples.systems import one_dof, rig, rig_model_nominal, three_dof
from jaxsid.examples.truth import exact_record, one_dof_record, three_dof_records
from jaxsid.examples.twin import rig_record, rig_torque

__all__ = [
    "chain",
    "chirp",
    "exact_record",
    "galileo",
    "mini_mast",
    "one_dof",
    "one_dof_record",
    "railway_vehicle",
    "rig",
    "rig_model_nominal",
    "rig_record",
    "rig_torque",
    "stepped_sine",
    "three_dof",
    "three_dof_records",
    "turbine_generator",
]
