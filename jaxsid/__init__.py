"""jaxsid: from measured records of a mechanical system to its modes and its mass, damping and stiffness."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsid.checks import InputError, InsufficientDataError, JaxsidError
    from jaxsid.files.model_toml import read_model, write_model
    from jaxsid.files.record_file import read_record, read_records
    from jaxsid.identification import Identification
    from jaxsid.pipeline.identify import identify
    from jaxsid.impulse.direct import Direct
    from jaxsid.impulse.ensemble import WaveletEnsemble
    from jaxsid.impulse.estimate import impulse_response
    from jaxsid.impulse.fourier import Fourier
    from jaxsid.impulse.inband import InBand
    from jaxsid.impulse.select import select_method
    from jaxsid.impulse.spectra import coherence, frequency_response
    from jaxsid.impulse.wavelet import Wavelet
    from jaxsid.mechanics.first_order import (
        modal_displacement_momentum,
        modal_displacement_velocity,
        physical_displacement_momentum,
        physical_displacement_velocity,
    )
    from jaxsid.mechanics.hold import continuous, discretise
    from jaxsid.mechanics.lumped import LumpedModel, lumped_model, second_order
    from jaxsid.mechanics.pencil import complex_modes
    from jaxsid.mechanics.simulate import markov_parameters, simulate, simulate_linear
    from jaxsid.modal import modal, modal_realization
    from jaxsid.physical.cbsi import cbsi
    from jaxsid.realization.era import era
    from jaxsid.realization.era_dc import era_dc
    from jaxsid.realization.order import select_order
    from jaxsid.realization.stabilization import stabilization
    from jaxsid.records import (
        ContinuousModel,
        ImpulseResponse,
        ModalModel,
        Realization,
        Record,
        SecondOrderModel,
    )

# Where each public name lives. Names are imported when first used, so that `import jaxsid` stays light.
_HOMES = {
    "jaxsid.checks": ("InputError", "InsufficientDataError", "JaxsidError"),
    "jaxsid.files.model_toml": ("read_model", "write_model"),
    "jaxsid.files.record_file": ("read_record", "read_records"),
    "jaxsid.identification": ("Identification",),
    "jaxsid.pipeline.identify": ("identify",),
    "jaxsid.impulse.direct": ("Direct",),
    "jaxsid.impulse.ensemble": ("WaveletEnsemble",),
    "jaxsid.impulse.estimate": ("impulse_response",),
    "jaxsid.impulse.fourier": ("Fourier",),
    "jaxsid.impulse.inband": ("InBand",),
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
    "jaxsid.mechanics.lumped": ("LumpedModel", "lumped_model", "second_order"),
    "jaxsid.mechanics.pencil": ("complex_modes",),
    "jaxsid.mechanics.simulate": ("markov_parameters", "simulate", "simulate_linear"),
    "jaxsid.modal": ("modal", "modal_realization"),
    "jaxsid.physical.cbsi": ("cbsi",),
    "jaxsid.realization.era": ("era",),
    "jaxsid.realization.era_dc": ("era_dc",),
    "jaxsid.realization.order": ("select_order",),
    "jaxsid.realization.stabilization": ("stabilization",),
    "jaxsid.records": (
        "ContinuousModel",
        "ImpulseResponse",
        "ModalModel",
        "Realization",
        "Record",
        "SecondOrderModel",
    ),
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
