"""The descent finds what it is asked for, keeps what it must, and goes on from where it was interrupted."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.guided import HIERARCHICAL, INDEPENDENT, PUBLISHED, SEARCHED, edit_towards
from avmsf.editing.modal_edit import ModalEdit
from avmsf.editing.reference import Reference
from avmsf.errors import EditError
from avmsf.modal.clips import level
from factories.raising import raises
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
    follow, stay = (
        trace(field, towards(pitch=0.9), config=QUICK, parameters=replace(PUBLISHED, gains_follow=each))[0]
        for each in (True, False)
    )
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
