"""jaxsid: from measured records of a mechanical system to its modes and its mass, damping and stiffness."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsid.checks import InputError as InputError
    from jaxsid.checks import InsufficientDataError as InsufficientDataError
    from jaxsid.checks import JaxsidError as JaxsidError
    from jaxsid.compilation import keep_programs as keep_programs
    from jaxsid.files.model_toml import read_model as read_model
    from jaxsid.files.model_toml import write_model as write_model
    from jaxsid.files.record_file import read_record as read_record
    from jaxsid.files.record_file import read_records as read_records
    from jaxsid.gap.diagnose import Diagnosis as Diagnosis
    from jaxsid.gap.diagnose import diagnose as diagnose
    from jaxsid.identification import Identification as Identification
    from jaxsid.impulse.direct import Direct as Direct
    from jaxsid.impulse.ensemble import WaveletEnsemble as WaveletEnsemble
    from jaxsid.impulse.estimate import impulse_response as impulse_response
    from jaxsid.impulse.fourier import Fourier as Fourier
    from jaxsid.impulse.inband import InBand as InBand
    from jaxsid.impulse.lines import record_lines as record_lines
    from jaxsid.impulse.select import select_method as select_method
    from jaxsid.impulse.spectra import coherence as coherence
    from jaxsid.impulse.spectra import frequency_response as frequency_response
    from jaxsid.impulse.wavelet import Wavelet as Wavelet
    from jaxsid.mechanics.first_order import modal_displacement_momentum as modal_displacement_momentum
    from jaxsid.mechanics.first_order import modal_displacement_velocity as modal_displacement_velocity
    from jaxsid.mechanics.first_order import physical_displacement_momentum as physical_displacement_momentum
    from jaxsid.mechanics.first_order import physical_displacement_velocity as physical_displacement_velocity
    from jaxsid.mechanics.hold import continuous as continuous
    from jaxsid.mechanics.hold import discretise as discretise
    from jaxsid.mechanics.lumped import Connection as Connection
    from jaxsid.mechanics.lumped import Effect as Effect
    from jaxsid.mechanics.lumped import Input as Input
    from jaxsid.mechanics.lumped import LumpedModel as LumpedModel
    from jaxsid.mechanics.lumped import Matrices as Matrices
    from jaxsid.mechanics.lumped import Sensor as Sensor
    from jaxsid.mechanics.lumped import Tolerance as Tolerance
    from jaxsid.mechanics.lumped import lumped_model as lumped_model
    from jaxsid.mechanics.lumped import second_order as second_order
    from jaxsid.mechanics.pencil import complex_modes as complex_modes
    from jaxsid.mechanics.simulate import markov_parameters as markov_parameters
    from jaxsid.mechanics.simulate import simulate as simulate
    from jaxsid.mechanics.simulate import simulate_linear as simulate_linear
    from jaxsid.modes import modal as modal
    from jaxsid.modes import modal_realization as modal_realization
    from jaxsid.physical.cbsi import cbsi as cbsi
    from jaxsid.pipeline.identify import identify as identify
    from jaxsid.pipeline.refine import refine as refine
    from jaxsid.realization.era import era as era
    from jaxsid.realization.era_dc import era_dc as era_dc
    from jaxsid.realization.order import select_order as select_order
    from jaxsid.realization.polish import polish as polish
    from jaxsid.realization.refit import refit_inputs as refit_inputs
    from jaxsid.realization.stabilization import stabilization as stabilization
    from jaxsid.records import ContinuousModel as ContinuousModel
    from jaxsid.records import ImpulseResponse as ImpulseResponse
    from jaxsid.records import ModalModel as ModalModel
    from jaxsid.records import Realization as Realization
    from jaxsid.records import Record as Record
    from jaxsid.records import SecondOrderModel as SecondOrderModel
    from jaxsid.refinement import Refinement as Refinement
    from jaxsid.uncertainty.ensemble import ensemble as ensemble
    from jaxsid.uncertainty.monte_carlo import monte_carlo as monte_carlo
    from jaxsid.uncertainty.noise import CorrelatedNoise as CorrelatedNoise
    from jaxsid.uncertainty.noise import IndependentNoise as IndependentNoise
    from jaxsid.uncertainty.noise import StationaryNoise as StationaryNoise
    from jaxsid.uncertainty.propagate import propagate as propagate
    from jaxsid.uncertainty.propagate import propagate_response as propagate_response

# Where each public name lives. Names are imported when first used, so that `import jaxsid` stays light.
_HOMES = {
    "jaxsid.checks": ("InputError", "InsufficientDataError", "JaxsidError"),
    "jaxsid.compilation": ("keep_programs",),
    "jaxsid.files.model_toml": ("read_model", "write_model"),
    "jaxsid.files.record_file": ("read_record", "read_records"),
    "jaxsid.gap.diagnose": ("Diagnosis", "diagnose"),
    "jaxsid.identification": ("Identification",),
    "jaxsid.pipeline.identify": ("identify",),
    "jaxsid.pipeline.refine": ("refine",),
    "jaxsid.refinement": ("Refinement",),
    "jaxsid.impulse.direct": ("Direct",),
    "jaxsid.impulse.ensemble": ("WaveletEnsemble",),
    "jaxsid.impulse.estimate": ("impulse_response",),
    "jaxsid.impulse.fourier": ("Fourier",),
    "jaxsid.impulse.inband": ("InBand",),
    "jaxsid.impulse.lines": ("record_lines",),
    "jaxsid.impulse.select": ("select_method",),
    "jaxsid.impulse.spectra": ("coherence", "frequency_response"),
    "jaxsid.impulse.wavelet": ("Wavelet",),
    "jaxsid.mechanics.first_order": (
        "modal_displacement_momentum",
        "modal_displacement_velocity",
        "physical_displacement_momentum",
        "physical_displacement_velocity",
    ),
    "jaxsid.mechanics.hold": ("continuous", "discretise"),
    "jaxsid.mechanics.lumped": (
        "Connection",
        "Effect",
        "Input",
        "LumpedModel",
        "Matrices",
        "Sensor",
        "Tolerance",
        "lumped_model",
        "second_order",
    ),
    "jaxsid.mechanics.pencil": ("complex_modes",),
    "jaxsid.mechanics.simulate": ("markov_parameters", "simulate", "simulate_linear"),
    "jaxsid.modes": ("modal", "modal_realization"),
    "jaxsid.physical.cbsi": ("cbsi",),
    "jaxsid.realization.era": ("era",),
    "jaxsid.realization.era_dc": ("era_dc",),
    "jaxsid.realization.order": ("select_order",),
    "jaxsid.realization.polish": ("polish",),
    "jaxsid.realization.refit": ("refit_inputs",),
    "jaxsid.realization.stabilization": ("stabilization",),
    "jaxsid.records": (
        "ContinuousModel",
        "ImpulseResponse",
        "ModalModel",
        "Realization",
        "Record",
        "SecondOrderModel",
    ),
    "jaxsid.uncertainty.ensemble": ("ensemble",),
    "jaxsid.uncertainty.monte_carlo": ("monte_carlo",),
    "jaxsid.uncertainty.noise": ("CorrelatedNoise", "IndependentNoise", "StationaryNoise"),
    "jaxsid.uncertainty.propagate": ("propagate", "propagate_response"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsid' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
