"""Physical parameters of struck strings from recordings, and sound from parameters.

All public names are listed here. Everything else may change without notice. A name is loaded when it is first used, so
`import pianofit` is fast and does not import JAX.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

__all__ = ["__version__"]
# Recordings, and their analysis without a hammer model.
__all__ += ["Recording", "load_recording", "recording_from_samples", "Analysis", "Partials", "analyse"]
# Setup and fit.
__all__ += ["Setup", "RecordingInfo", "Measured", "fit", "Result", "Quantity", "Quantities"]
__all__ += ["objective", "RecordingObjective"]
__all__ += ["Covariance", "compare", "Comparison", "ComparedQuantity"]
# Prediction of recordings that were not fitted.
__all__ += ["Prediction", "predict_recording", "CrossValidation", "LeftOutRecording", "cross_validate"]
__all__ += ["ModelDraw", "DerivedQuantity"]
# Model: from parameters to motion and sound.
__all__ += [
    "String",
    "Hammer",
    "SoftHammer",
    "RelaxingHammer",
    "Pluck",
    "Geometry",
    "PARAMETERS",
    "Preset",
    "preset",
    "typical",
    "Simulation",
]
__all__ += ["simulate", "SyntheticRecording", "synthetic_recording", "Note", "load_note", "encode_wav", "write_wav"]
# Labelled synthetic notes, for machine learning.
__all__ += ["NoteOptions", "LabelledNote", "notes", "note_from_labels", "DatasetSummary", "write_dataset"]
__all__ += ["render_notes", "ContactGrid", "contact_grid"]
# Parts of the model for JAX programs: modes, excitation, output.
__all__ += ["Modes", "mode_table", "strike", "pluck", "FeltLaw", "Parameter", "levels", "spectrum", "waveform"]
# Instruments of 88 keys from fits, songs, and exports.
__all__ += ["Instrument", "Key", "VelocityCurve", "find_fits", "load_keys", "load_extras"]
__all__ += ["build_instrument", "load_instrument", "KeyPrior", "prior_of_key", "write_instrument"]
__all__ += ["Song", "load_song", "PedalRange", "PlayOptions", "Performance", "render_song"]
__all__ += ["ExportOptions", "ExportSummary"]
__all__ += ["export_sampler", "FaustSummary", "write_faust", "PageSummary", "write_playable_page"]
# Tuning of a piano.
__all__ += ["tuning", "Tuning", "TunedKey", "PartialBeat", "IntervalValue", "write_tuning"]
# Libraries, and blind listening tests.
__all__ += ["fit_library", "ListeningSummary", "write_listening_test", "count_answers"]
# Errors.
__all__ += ["PianofitError", "RecordingError", "SetupError", "ParameterError", "AnalysisError", "FitError"]
__all__ += ["OutputError", "WrongNoteError"]

if TYPE_CHECKING:
    from .analysis import Analysis, Partials, analyse
    from .dataset import DatasetSummary, LabelledNote, NoteOptions, note_from_labels, notes, write_dataset
    from .errors import (
        AnalysisError,
        FitError,
        OutputError,
        ParameterError,
        PianofitError,
        RecordingError,
        SetupError,
        WrongNoteError,
    )
    from .excitation import Pluck
    from .export import ExportOptions, ExportSummary, export_sampler
    from .export.faust import FaustSummary, write_faust
    from .felt import FeltLaw, RelaxingHammer, SoftHammer
    from .fitting import fit, objective
    from .inference import RecordingObjective
    from .instrument import (
        Instrument,
        Key,
        VelocityCurve,
        build_instrument,
        find_fits,
        load_extras,
        load_instrument,
        load_keys,
        prior_of_key,
        write_instrument,
    )
    from .io.files import encode_wav, write_wav
    from .key_prior import KeyPrior
    from .library import fit_library
    from .listening.result import count_answers
    from .listening.sounds import ListeningSummary, write_listening_test
    from .literature import Preset, preset, typical
    from .model import Modes, Note, Simulation, levels, mode_table, pluck, simulate, spectrum, strike, waveform
    from .model.contact_grid import ContactGrid, contact_grid
    from .model.many_notes import render_notes
    from .parameters import PARAMETERS, Geometry, Hammer, Parameter, String
    from .playback import PedalRange, Performance, PlayOptions, Song, load_song, render_song
    from .recording.recording import Recording, load_recording, recording_from_samples
    from .report.compare import ComparedQuantity, Comparison, compare
    from .result import Result
    from .result.cross_validation import CrossValidation, LeftOutRecording, cross_validate
    from .result.derived import DerivedQuantity, ModelDraw
    from .result.prediction import Prediction, predict_recording
    from .schema.notes import load_note
    from .schema.quantities import Covariance, Quantities, Quantity
    from .schema.tuning import IntervalValue, PartialBeat, TunedKey, Tuning
    from .setup import Measured, RecordingInfo, Setup
    from .synthetic import SyntheticRecording, synthetic_recording
    from .tuner.save import write_tuning
    from .tuner.tuning import tuning
    from .web import PageSummary, write_playable_page

_MODULES = {
    "analysis": ("Analysis", "Partials", "analyse"),
    "dataset": ("DatasetSummary", "LabelledNote", "NoteOptions", "note_from_labels", "notes", "write_dataset"),
    "export": ("ExportOptions", "ExportSummary", "export_sampler"),
    "export.faust": ("FaustSummary", "write_faust"),
    "instrument": (
        "Instrument",
        "Key",
        "VelocityCurve",
        "build_instrument",
        "find_fits",
        "load_extras",
        "load_instrument",
        "load_keys",
        "prior_of_key",
        "write_instrument",
    ),
    "listening.result": ("count_answers",),
    "listening.sounds": ("ListeningSummary", "write_listening_test"),
    "playback": ("PedalRange", "Performance", "PlayOptions", "Song", "load_song", "render_song"),
    "web": ("PageSummary", "write_playable_page"),
    "errors": tuple(name for name in __all__ if name.endswith("Error")),
    "fitting": ("fit", "objective"),
    "library": ("fit_library",),
    "inference": ("RecordingObjective",),
    "report.compare": ("ComparedQuantity", "Comparison", "compare"),
    "result": ("Result",),
    "result.derived": ("DerivedQuantity", "ModelDraw"),
    "result.cross_validation": ("CrossValidation", "LeftOutRecording", "cross_validate"),
    "result.prediction": ("Prediction", "predict_recording"),
    "excitation": ("Pluck",),
    "felt": ("FeltLaw", "RelaxingHammer", "SoftHammer"),
    "model": (
        "Modes",
        "Note",
        "Simulation",
        "levels",
        "mode_table",
        "pluck",
        "simulate",
        "spectrum",
        "strike",
        "waveform",
    ),
    "model.contact_grid": ("ContactGrid", "contact_grid"),
    "model.many_notes": ("render_notes",),
    "parameters": ("PARAMETERS", "Geometry", "Hammer", "Parameter", "String"),
    "literature": ("Preset", "preset", "typical"),
    "recording.recording": ("Recording", "load_recording", "recording_from_samples"),
    "io.files": ("encode_wav", "write_wav"),
    "key_prior": ("KeyPrior",),
    "schema.notes": ("load_note",),
    "schema.quantities": ("Covariance", "Quantities", "Quantity"),
    "schema.tuning": ("IntervalValue", "PartialBeat", "TunedKey", "Tuning"),
    "setup": ("Measured", "RecordingInfo", "Setup"),
    "synthetic": ("SyntheticRecording", "synthetic_recording"),
    "tuner.save": ("write_tuning",),
    "tuner.tuning": ("tuning",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> Any:
        """Load a public name from its module (PEP 562)."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
