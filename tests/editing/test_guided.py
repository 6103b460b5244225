"""The descent finds what it is asked for and goes on where it was interrupted; recordings and materials as its aim."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.guided import HIERARCHICAL, INDEPENDENT, PUBLISHED, SEARCHED, edit_towards
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.editing.reference import Reference, band_spectrum, gain_slope
from avmsf.errors import AvmsfWarning, EditError
from avmsf.fem.material import CERAMIC, WOOD
from avmsf.modal.spectra import level, levelled, with_length
from factories.raising import raises, warns
from factories.ringing_field import RATE, SameGains, ringing_field, sound_of

QUICK = GuidedEditConfig(steps=12, contacts_per_step=2, preview_every=5, seconds=0.25, fft_sizes=(2048, 512))


@dataclass
class Towards:
    """Pulls towards one sound, from where the field is, with a little noise of each step's chance."""

    sound: torch.Tensor
    noise: float = 0.0
    spoilt: bool = False
    sample_rate: float = RATE

    def describe(self):
        return {"towards": float(self.sound.square().sum()), "noise": self.noise}

    def start(self, struck):
        return ModalEdit.none(struck.field.bank)

    def targets(self, sounds, step, generator):
        found = self.sound[:, : sounds.shape[1]].expand(len(sounds), -1).clone()
        found += self.noise * float(found.std()) * torch.randn(found.shape, generator=generator)
        if self.spoilt:
            found[0 if step % 2 else slice(None), 7] = math.nan
        return found


def towards(**change: float) -> Towards:
    return Towards(sound_of(ringing_field(**change)))


def trace(field, guide, **arguments):
    seen = []
    made = edit_towards(field, guide, progress=seen.append, **arguments)
    return made, seen


@torch.no_grad()
def test_a_small_change_is_found_by_descent():
    made, seen = trace(ringing_field(), towards(pitch=1.004, damping=1.5), config=replace(QUICK, steps=50))
    wanted = ringing_field(pitch=1.004, damping=1.5).bank
    # A quarter of the change, 1.7 cents; the dampings' own slopes are shallow.
    torch.testing.assert_close(made.bank.frequency, wanted.frequency, rtol=1e-3, atol=0)
    torch.testing.assert_close(made.bank.damping, wanted.damping, rtol=0.1, atol=0)
    assert seen[-1].loss < 0.2 * seen[0].loss
    # Previews come when due, and sound as the field will.
    assert [each.step for each in seen if each.preview is not None] == [*range(5, 51, 5)]
    torch.testing.assert_close(seen[-1].preview, sound_of(made)[0], rtol=0, atol=1e-6)
    # The common factors bring most of it.
    assert seen[-1].decay == pytest.approx(1 / 1.5, rel=0.2)
    assert seen[-1].pitch == pytest.approx(1.004, abs=0.002)


def test_common_factors_cross_the_gap_that_single_modes_do_not():
    # An octave down and four times as damped: no mode is near one that is wanted.
    field, reference = ringing_field(), Reference.of(sound_of(ringing_field(pitch=0.5, damping=4.0)), sample_rate=RATE)
    config = replace(QUICK, steps=15)
    ours, _ = trace(field, reference, config=config)
    alone, _ = trace(field, reference, config=config, parameters=INDEPENDENT)
    wanted = ringing_field(pitch=0.5, damping=4.0).bank
    off = [float((made.bank.frequency / wanted.frequency).log().abs().max()) for made in (ours, alone)]
    assert off[0] < 0.01
    assert off[1] > 0.3


def test_level_is_no_part_of_the_edit():
    # Whatever the field's unit, and however loud what it shall sound like.
    for factor in (1.0, 1e-4):
        field = ringing_field(level=factor)
        made = edit_towards(field, towards(pitch=1.02, damping=2.0, level=factor), config=QUICK)
        before, after = (level(sound_of(each), sample_rate=RATE) for each in (field, made))
        torch.testing.assert_close(after, before, rtol=1e-4, atol=0)


def test_modes_beyond_the_count_follow_the_common_factors_alone():
    field = ringing_field()
    made = edit_towards(field, towards(pitch=1.01), config=replace(QUICK, free_modes=2))
    entry = made.origin.report["edits"][-1]
    ratio = made.bank.frequency / field.bank.frequency / entry["pitch"]
    alone = (ratio - 1).abs() > 1e-9
    assert int(alone.sum()) == 2
    energy = torch.tensor([1.0, 0.8, 0.9, 0.6, 0.7, 0.4]).square() / field.bank.damping
    assert set(alone.nonzero().flatten().tolist()) == set(energy.argsort(descending=True)[:2].tolist())


def test_the_published_form_has_one_factor_on_frequencies_and_gains_that_follow_them():
    field = ringing_field()
    both = (replace(PUBLISHED, gains_follow=each) for each in (True, False))
    follow, stay = (trace(field, towards(pitch=0.9), config=QUICK, parameters=each)[0] for each in both)
    entry = follow.origin.report["edits"][-1]
    assert entry["pitch"] == pytest.approx(0.9, rel=0.03)
    assert entry["decay"] == 1.0
    torch.testing.assert_close(follow.bank.frequency, stay.bank.frequency)
    # The level of the whole is none of the edit's.
    ratio = follow.gain_field.scale / stay.gain_field.scale * (follow.bank.frequency / field.bank.frequency)
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-6, atol=0)


def test_a_search_begins_where_it_found_and_its_common_factors_stay_there():
    class Proposing(Towards):
        def start(self, struck):
            return ModalEdit.none(struck.field.bank, pitch=math.log(0.5), damping=math.log(2.0))

    guide = Proposing(sound_of(ringing_field(pitch=0.5)))
    made, seen = trace(ringing_field(), guide, config=replace(QUICK, steps=2, preview_every=0), parameters=SEARCHED)
    assert (seen[-1].pitch, seen[-1].decay) == (pytest.approx(0.5), pytest.approx(0.5))
    # Two steps of single modes are a 25th at most.
    ratio = made.bank.frequency / ringing_field().bank.frequency
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.5), rtol=0.05, atol=0)
    assert not torch.allclose(ratio, torch.full_like(ratio, 0.5), rtol=1e-3)


def test_stiffness_keeps_modes_together():
    def spread(stiffness: float) -> float:
        guide = Towards(sound_of(ringing_field()).roll(1) + sound_of(ringing_field(pitch=1.03)))
        parameters = replace(HIERARCHICAL, stiffness=stiffness)
        field = ringing_field()
        made = edit_towards(field, guide, config=replace(QUICK, steps=25), parameters=parameters)
        return float((made.bank.frequency / field.bank.frequency).log().std())

    assert spread(100.0) < 0.3 * spread(0.0)


@pytest.mark.parametrize("stop", [1, 7, 12])
def test_an_interrupted_edit_goes_on_to_the_same_result(tmp_path, stop):
    field, guide, place = ringing_field(), replace(towards(pitch=1.02, damping=1.3), noise=0.3), tmp_path / "state"

    def interrupt(progress) -> None:
        if progress.step == stop:
            raise KeyboardInterrupt

    whole = edit_towards(field, guide, config=QUICK)
    with pytest.raises(KeyboardInterrupt):
        edit_towards(field, guide, config=QUICK, progress=interrupt, checkpoint=place)
    resumed, seen = trace(field, guide, config=QUICK, checkpoint=place)
    assert [each.step for each in seen] == list(range(stop + 1, 13))
    assert torch.equal(resumed.bank.frequency, whole.bank.frequency)
    assert torch.equal(resumed.bank.damping, whole.bank.damping)
    assert torch.equal(sound_of(resumed), sound_of(whole))


def test_a_checkpoint_of_another_edit_is_refused_by_name(tmp_path):
    place, guide = tmp_path / "state", towards(pitch=1.02)
    edit_towards(ringing_field(), guide, config=QUICK, checkpoint=place)
    with raises(EditError, file=place, value=["field"]):
        edit_towards(ringing_field(pitch=1.1), guide, config=QUICK, checkpoint=place)
    with raises(EditError, file=place, value=["guide"]):
        edit_towards(ringing_field(), towards(pitch=1.03), config=QUICK, checkpoint=place)
    # How often previews come changes nothing.
    edit_towards(ringing_field(), guide, config=replace(QUICK, preview_every=3), checkpoint=place)
    with raises(EditError, file=place, value=["settings"]):
        edit_towards(ringing_field(), guide, config=replace(QUICK, steps=13), checkpoint=place)


def test_targets_that_are_not_finite_are_left_out_and_nothing_but_such_ends_the_edit():
    _, seen = trace(ringing_field(), replace(towards(pitch=1.01), spoilt=True), config=QUICK)
    # Even steps have no usable target, odd ones one of two.
    assert [math.isnan(each.loss) for each in seen] == [True, False] * 6
    guide = Towards(torch.full((1, 4000), math.nan))
    with raises(EditError, name="targets", value=20):
        edit_towards(ringing_field(), guide, config=replace(QUICK, steps=40))


@pytest.mark.parametrize(
    ("name", "value"),
    [("steps", 0), ("free_modes", 0), ("seconds", -1.0), ("fft_sizes", (1023,)), ("seed", 2**70), ("seconds", 0.04)],
)
def test_edits_that_cannot_be_meant_are_refused(name, value):
    with raises(EditError, name=name, value=value):
        GuidedEditConfig(**{name: value})
    reference = Reference.of(sound_of(ringing_field()), sample_rate=2 * RATE, name="bell.wav")
    with raises(EditError, name="sample_rate", value=2 * RATE):
        edit_towards(ringing_field(), reference, config=QUICK)
    field = replace(ringing_field(), gain_field=SameGains(torch.zeros(6)))
    with raises(EditError, name="field", value=0.0):
        edit_towards(field, towards(), config=QUICK)


def write(path: Path, sound: torch.Tensor, *, rate: float = RATE, before: int = 0) -> Path:
    samples = np.concatenate([np.zeros(before), sound.double().numpy()])
    soundfile.write(path, samples, round(rate), subtype="FLOAT")
    return path


def struck(**change: float) -> FieldAtContacts:
    field = ringing_field(**change)
    return FieldAtContacts(field, field.known(field.gain_field.points), field.samples)


def test_a_recording_begins_at_its_onset_at_the_fields_rate(tmp_path):
    # Recorded at four times the field's rate, with a tenth of a second of silence before.
    field = ringing_field()
    times = torch.arange(16000, dtype=torch.float64) / (4 * RATE)
    terms = zip(field.gains(torch.zeros(1, 3))[0].double(), field.bank.frequency, field.bank.damping, strict=True)
    fast = sum(gain * torch.exp(-d * times) * torch.sin(2 * math.pi * f * times) for gain, f, d in terms)
    path = write(tmp_path / "hit.wav", fast, rate=4 * RATE, before=3200)
    reference = Reference.read(path, sample_rate=RATE)
    assert reference.lengths[0] == pytest.approx(4000, abs=4)
    found = band_spectrum(reference.clips[:, :3990])
    torch.testing.assert_close(found, band_spectrum(sound_of(field)[:, :3990]), rtol=0, atol=2e-3)


def test_several_clips_each_sound_has_its_nearest(tmp_path):
    pitches = (0.6, 1.0, 1.7)
    for pitch in pitches:
        write(tmp_path / f"{pitch}.wav", sound_of(ringing_field(pitch=pitch))[0])
    reference = Reference.read(tmp_path, sample_rate=RATE)
    heard = torch.cat([sound_of(ringing_field(pitch=1.05 * pitch, level=5.0)) for pitch in pitches])
    targets = reference.targets(heard, 0, torch.Generator())
    torch.testing.assert_close(level(targets, sample_rate=RATE), level(heard, sample_rate=RATE))
    wanted = torch.cat([sound_of(ringing_field(pitch=pitch)) for pitch in pitches])
    # Onsets lie within a sample or two of where the files begin.
    torch.testing.assert_close(band_spectrum(targets), band_spectrum(wanted), rtol=0, atol=2e-3)


def test_where_a_clip_ends_nothing_is_asked():
    field = ringing_field()
    sound = sound_of(field)
    reference = Reference.of(sound_of(ringing_field(damping=3.0))[:, :1000], sample_rate=RATE)
    targets = reference.targets(sound, 0, torch.Generator())
    assert torch.equal(targets[:, 1000:], sound[:, 1000:])
    # Until the 10 ms before the end it is the clip alone.
    early = levelled(with_length(reference.clips, 4000), sound, sample_rate=RATE)
    torch.testing.assert_close(targets[:, :900], early[:, :900])


@pytest.mark.parametrize(
    ("pitch", "damping", "samples"),
    [(0.5, 4.0, 4000), (1.6, 0.5, 4000), (1.0, 10.0, 4000), (1.6, 0.5, 800), (1.0, 4.0, 400)],
)
def test_the_start_finds_a_common_change(pitch, damping, samples):
    # Clips of 800 and 400 samples end while they ring: of what comes later, nothing is known.
    reference = Reference.of(sound_of(ringing_field(pitch=pitch, damping=damping))[:, :samples], sample_rate=RATE)
    found = reference.start(struck())
    # Bands are a 24th of an octave, 3 %; dampings are searched to a factor of 64^(1/32), 14 %.
    assert found.pitch_factor == pytest.approx(pitch, rel=0.04)
    assert 1 / found.decay_factor == pytest.approx(damping, rel=0.35)


def test_the_start_stays_within_its_range_and_where_it_fits():
    # A hundredth of the damping is out of reach.
    reference = Reference.of(sound_of(ringing_field(damping=1e-2, seconds=0.1)), sample_rate=RATE)
    assert reference.start(struck(seconds=0.1)).decay_factor == pytest.approx(64)
    same = Reference.of(sound_of(ringing_field()), sample_rate=RATE).start(struck())
    assert (same.pitch_factor, same.decay_factor) == (1.0, 1.0)


def test_heard_spectra_shift_with_pitch_and_ignore_level():
    one, double = (band_spectrum(sound_of(ringing_field(pitch=pitch, damping=pitch))) for pitch in (0.5, 1.0))
    torch.testing.assert_close(one.sum(1), torch.ones(1))
    # An octave is 24 bands; each mode's width doubles with its frequency.
    torch.testing.assert_close(one.roll(24, 1)[:, 60:], double[:, 60:], rtol=0, atol=3e-3)
    loud = band_spectrum(1e3 * sound_of(ringing_field()))
    torch.testing.assert_close(loud, double, rtol=1e-4, atol=1e-7)
    # The level is that of the impact, whatever the decay.
    short, long = (sound_of(ringing_field(damping=damping)) for damping in (1.0, 0.25))
    assert float(level(long, sample_rate=RATE) / level(short, sample_rate=RATE)) == pytest.approx(1.0, abs=0.25)
    torch.testing.assert_close(level(3 * short, sample_rate=RATE), 3 * level(short, sample_rate=RATE))


def test_of_two_blows_the_first_is_taken_and_that_is_said(tmp_path):
    first, second = (sound_of(ringing_field(pitch=pitch, seconds=0.25))[0] for pitch in (1.0, 1.4))
    both = write(tmp_path / "both.wav", torch.cat([first, second]), before=800)
    with warns(AvmsfWarning, file=both, name="impacts") as caught:
        reference = Reference.read(both, sample_rate=RATE)
    assert caught[0].message.value == pytest.approx((0.1, 0.35), abs=0.005)
    # The second blow is found to half a window of 10 ms, and none of it is left.
    assert reference.lengths[0] == pytest.approx(2000, abs=40)
    found = band_spectrum(reference.clips[:, :1950])
    torch.testing.assert_close(found, band_spectrum(first[None, :1950]), rtol=0, atol=2e-3)


def test_brightness_is_the_slope_of_audible_gains():
    frequency = torch.exp(torch.linspace(math.log(200.0), math.log(3200.0), 50, dtype=torch.float64))
    gains = 200.0 / frequency
    # Gains in inverse proportion to frequency fall by 6.02 dB an octave; muted modes say nothing of it.
    for muted in (None, 0, 49):
        heard = gains.clone() if muted is None else gains.index_fill(0, torch.tensor(muted), 0.0)
        assert gain_slope(frequency, heard) == pytest.approx(-20 * math.log10(2), rel=1e-6)


def test_made_up_impacts_are_of_the_object_in_another_material():
    field = ringing_field()
    made = Reference.of_material(field, CERAMIC, WOOD, count=6, seed=1)
    assert not torch.allclose(made.clips[0], made.clips[1])
    power = torch.fft.rfft(made.clips.double()).abs().square().sum(0)
    hertz = torch.fft.rfftfreq(field.samples, 1 / RATE)
    ratio = math.sqrt(WOOD.young / CERAMIC.young * CERAMIC.density / WOOD.density)
    lowest, highest = (ratio * float(each) for each in (field.bank.frequency[0], field.bank.frequency[-1]))
    # Wood's modes are some ten hertz wide.
    assert float(power[(hertz > 0.8 * lowest) & (hertz < 1.2 * highest)].sum() / power.sum()) > 0.95
    assert made.start(struck()).decay_factor < 0.5
    # A mode's size does not depend on its phase.
    rotated = SameGains(field.gain_field.gains * torch.exp(1j * torch.linspace(0.0, 1.5, 6)))
    same = Reference.of_material(replace(field, gain_field=rotated), CERAMIC, WOOD, count=6, seed=1)
    torch.testing.assert_close(same.clips, made.clips, rtol=1e-4, atol=1e-4)


def test_clipping_and_a_low_rate_are_warned_of(tmp_path):
    sound = sound_of(ringing_field())[0]
    hard = write(tmp_path / "hard.wav", (4 * sound / sound.abs().max()).clamp(-1.0, 1.0), before=800)
    low = write(tmp_path / "low.wav", sound[::8], rate=RATE / 8, before=100)
    for path, name, value in ((hard, "clipping", None), (low, "sample_rate", 1000.0)):
        with warns(AvmsfWarning, file=path, name=name, value=value):
            Reference.read(path, sample_rate=RATE)


NOISE = torch.randn(4000, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("sound", "attributes"),
    [(None, {}), (torch.zeros(4000), {"value": 0.0}), (NOISE[:100], {"name": "samples"}), (NOISE, {})],
    ids=["missing", "silent", "short", "noise"],
)
def test_recordings_that_cannot_be_used_are_refused(sound, attributes, tmp_path):
    if sound is not None:
        write(tmp_path / "hit.wav", sound)
    with raises(EditError, file="hit.wav", **attributes):
        Reference.read(tmp_path / "hit.wav", sample_rate=RATE)


def test_clips_and_fields_without_sound_are_refused(tmp_path):
    with raises(EditError, file=tmp_path, name="reference"):
        Reference.read(tmp_path, sample_rate=RATE)
    for clips, row, value in (
        (torch.stack([torch.ones(9), torch.zeros(9)]), 1, 0.0),
        (torch.full((1, 9), math.nan), 0, None),
    ):
        with raises(EditError, name="clips", row=row, value=value):
            Reference.of(clips, sample_rate=RATE)
    with raises(EditError, name="gains", value=0.0):
        Reference.of_material(replace(ringing_field(), gain_field=SameGains(torch.zeros(6))), CERAMIC, WOOD)
    # All modes at half the rate or above sound nowhere.
    with raises(EditError, name="frequency"):
        Reference.of_material(ringing_field(pitch=100.0), CERAMIC, WOOD)
