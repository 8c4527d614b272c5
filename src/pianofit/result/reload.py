"""Reloading of a fit: its recordings and their sounds, from the original files.

The record of the fit has the compared levels. Recordings are read and analysed again, from files whose SHA-256 must
equal the stored one.
"""

from collections.abc import Sequence

from ..analysis import SAME_KEY_CENTS, Analysis, analyse, cents_above
from ..errors import AnalysisError, FitError, ParameterError, RecordingError
from ..io.files import printable
from ..model.note import Note
from ..recording.recording import Recording, Source, to_recording
from ..schema.fit import Fit, RecordingFit
from ..schema.notes import initial_note
from ..threads import numerical_settings
from .comparison import RecordingComparison
from .fitted_recording import FittedRecording


@numerical_settings()
def reload_recordings(fit: Fit, notes: Sequence[Note], sources: Sequence[Source] = ()) -> tuple[FittedRecording, ...]:
    """The recordings of a fit, read from their stored paths or from `sources`, in their order.

    `notes` are those of the best minimum. Raises `FitError` if a file is missing or is not the one that was fitted.
    """
    records = fit.recordings
    if sources and len(sources) != len(records):
        raise FitError(
            f"{len(sources)} recordings were given, but the fit has {len(records)}; give all, in their order"
        )
    recordings = [
        _read(record, source)
        for record, source in zip(records, sources or [record.file for record in records], strict=True)
    ]
    own = [
        _analyse_fitted_note(recording, record, note)
        for recording, record, note in zip(recordings, records, notes, strict=True)
    ]
    analyses = [analysis.with_decay_law(own[fit.reference_index]) for analysis in own]
    pairs = enumerate(zip(recordings, analyses, strict=True))
    return tuple(_compare(fit, notes, index, *pair) for index, pair in pairs)


def _read(record: RecordingFit, source: Source) -> Recording:
    """Read one recording and check that it is the fitted one."""
    channel = "average" if record.channel == "mono" else record.channel
    try:
        recording = to_recording(source, channel, printable(record.file))
    except (ParameterError, RecordingError) as error:
        raise FitError(f"{error}, or give the recording of the fit as result.with_recordings(path)") from None
    if recording.sha256 != record.sha256:
        raise FitError(
            f"{printable(recording.path)}: is not the recording of this fit, or was changed (SHA-256); give the "
            "original as result.with_recordings(path)"
        )
    return recording


def _analyse_fitted_note(recording: Recording, record: RecordingFit, note: Note) -> Analysis:
    """The analysis at the name of the fitted note, or else at its pitch."""
    try:
        analysis = analyse(recording, note=record.note)
        if abs(cents_above(analysis.f0, float(note.f0))) <= SAME_KEY_CENTS:
            return analysis
    except (AnalysisError, ParameterError):
        pass
    try:
        return analyse(recording, f0=float(note.f0))
    except (AnalysisError, ParameterError) as error:
        raise FitError(str(error)) from None


def _compare(fit: Fit, notes: Sequence[Note], index: int, recording: Recording, analysis: Analysis) -> FittedRecording:
    """Compare one recording with the model, as during the fit."""
    record, note = fit.recordings[index], notes[index]
    gain = float(note.gain) if record.gain_status == "given" else None
    comparison = RecordingComparison(recording, analysis, None if gain is None else 1.0 / gain)
    plain = note._replace(gain=1.0, modal_response=None)
    begins = comparison.contact(plain)
    initial = comparison.render(initial_note(fit, record, note), gain, begins)
    fitted = comparison.render(plain, float(note.gain), begins)
    compared = FittedRecording(initial, fitted, recording, analysis, record.partials, record.criterion, record.levels)
    return (
        compared
        if note.modal_response is None
        else compared.add_modal_response(note.modal_response, _contact_delay(fit, notes, index), float(note.gain))
    )


def _contact_delay(fit: Fit, notes: Sequence[Note], index: int) -> float:
    """Time from the onset to the first contact, s. Layers of a modal response are a path group by size of stroke."""
    group = fit.path_groups[fit.recordings[index].path_group]
    group.sort(key=lambda i: float(notes[i].size))
    layers = () if fit.modal_response is None else fit.modal_response.layers
    if len(layers) != len(group):
        raise FitError("modal_response.layers must have an entry for each recording of the path group; fit again")
    return layers[group.index(index)].contact_s
