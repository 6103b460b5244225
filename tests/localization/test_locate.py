import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import LocationError
from avmsf.field.gains.model import Gains
from avmsf.field.sound_field import Origin
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.likelihood import Force, Likelihood, PredictedGains
from avmsf.localization.locate import REJECT_ABOVE, assess_match, locate, locate_impacts
from avmsf.localization.locator import Locator
from avmsf.localization.prediction import distinct_contacts
from avmsf.modal.modes import ModalBank, synthesize
from factories.believing_field import bar_contacts, drawn_gains, elastic_field, sound_field
from factories.located_plate import PLATE, TrueGains, bank, field_of, held, locator_of, missed, struck, true_field
from factories.raising import raises
from oracles.plate import plate_surface_points


@pytest.mark.parametrize(
    ("taps", "noise_db", "posterior", "cosine"),
    [(None, -20.0, 0.01, 0.01), (60, -40.0, 0.02, 0.04), (12, -20.0, 0.09, 0.14)],
    ids=str,
)
def test_a_blow_is_found_and_the_region_holds_it(taps, noise_db, posterior, cosine):
    locator, impacts = locator_of(taps), struck(40, seed=77, noise_db=noise_db)
    found = [locator.locate(sound) for sound in impacts.sounds]
    pairs = list(zip(found, impacts.contacts, strict=True))
    # A point drawn by chance is .17 of the diagonal off.
    assert sum(missed(each, each.most_probable, contact) for each, contact in pairs) / 40 < posterior
    assert sum(missed(each, each.best, contact) for each, contact in pairs) / 40 < cosine
    coverage = sum(held(each, contact) for each, contact in pairs) / 40
    assert 0.8 <= coverage <= 1.0
    assert sum(float(each.region().double().mean()) for each in found) / 40 < 0.5
    assert all(abs(float(each.probability.sum()) - 1.0) < 1e-9 for each in found)


def test_force_polarity_and_onset_do_not_matter():
    locator, impacts = locator_of(), struck(1, seed=3)
    found = locator.locate(impacts.sounds[0])
    turned = locator.locate(-300.0 * impacts.sounds[0])
    assert turned.most_probable == found.most_probable
    torch.testing.assert_close(turned.distance, found.distance, atol=1e-5, rtol=0)
    assert turned.force == pytest.approx(-300.0 * found.force, rel=1e-3)
    # Nor does the evidence depend on them.
    assert turned.evidence == pytest.approx(found.evidence, abs=0.1)
    assert locator.locate(impacts.sounds[0], force=Force(1.0)).evidence == pytest.approx(found.evidence, rel=0.01)
    late = locator.locate(impacts.sounds[0][3:])
    assert missed(late, late.most_probable, impacts.contacts[0]) < 0.02
    assert late.explained_energy > 0.9
    assert float(late.distance.min()) < 0.1


@pytest.mark.parametrize("factor", [0.997, 1.002])
def test_an_object_that_has_warmed_or_cooled_is_located_alike(factor: float) -> None:
    field = true_field()
    locator = Locator.of(field)
    tuned = replace(field, bank=ModalBank(factor * field.bank.frequency, field.bank.damping))
    for contact in field.gain_field.points[[3, 123, 400]]:
        found = locator.locate(tuned.modal_sounds(tuned.known(contact[None]), 7200)[0])
        assert missed(found, found.most_probable, contact) < 0.02
        assert found.explained_energy > 0.95


@pytest.mark.parametrize("factor", [0.998, 1.0, 1.003])
@pytest.mark.parametrize(("seconds", "modes"), [(0.04, 24), (0.1, 64), (0.3, 96)])
def test_a_sound_is_stretched_until_the_modes_explain_all_but_its_noise(
    seconds: float, modes: int, factor: float
) -> None:
    rate, samples, generator = 44_100.0, round(44_100 * seconds), torch.Generator().manual_seed(1)
    frequency = 200.0 * 40.0 ** torch.rand(modes, generator=generator, dtype=torch.float64).sort().values
    known = ModalBank(frequency, 3.0 + 0.004 * frequency)
    gains = torch.randn(1, modes, generator=generator, dtype=torch.float64) + 0j
    sound = synthesize(gains, factor * frequency, known.damping, samples=2 * samples, sample_rate=rate)[0]
    sound += 0.1 * sound[:samples].std() * torch.randn(2 * samples, generator=generator)
    extractor = Extractor(known, sample_rate=rate, samples=samples)
    found = extractor.stretched_to_modes(sound.float())
    assert extractor.explained(found) > 0.985 * float(found.square().sum())


def test_complex_gains_and_phases_are_what_the_field_renders():
    field = field_of(TrueGains(plate_surface_points(PLATE, 600).float(), turned=True), phase=0.7)
    sound = field.modal_sounds(field.known(field.gain_field.points[123:124]), 7200)[0]
    found = Locator.of(field).locate(sound)
    assert float(found.distance[123]) < 1e-6
    assert found.explained_energy > 0.999
    assert found.force == pytest.approx(1.0, rel=1e-2)


def test_dampings_that_vary_are_accounted_for():
    field = field_of(TrueGains(plate_surface_points(PLATE, 600).float(), factor=2.0))
    sound = field.modal_sounds(field.known(field.gain_field.points[123:124]), 7200)[0]
    corrected = Locator.of(field)
    plain = replace(corrected, dampings=None)
    distance = [float(each.locate(sound).distance[123]) for each in (corrected, plain)]
    assert distance[0] < 0.5 * distance[1]


def test_a_known_force_tells_places_apart_that_sound_alike():
    # Two points that differ in nothing but how loud they are.
    class Twice(TrueGains):
        def predict(self, points, directions=None):
            return Gains((1.0 + points[:, :1].float()) * torch.linspace(1, 2, len(bank())))

    field = field_of(Twice(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])))
    locator, sound = Locator.of(field), field.render(torch.tensor([[1.0, 0, 0]]))[0]
    known = [locator.locate(sound, force=Force(each, spread_db=0.5)).probability for each in (1.0, 2.0)]
    assert float(known[0][1]) > 0.99
    assert float(known[1][0]) > 0.99


def test_a_force_that_the_level_contradicts_is_noted():
    sound = struck(1, seed=3).sounds[0]
    force = abs(locator_of().locate(sound).force)
    assert locator_of().locate(sound, force=1.5 * force).notes == ()
    for factor in (0.05, 20.0):
        (note,) = locator_of().locate(sound, force=factor * force).notes
        assert f"{factor * force:.3g}" in note


def test_the_region_grows_with_the_noise():
    locator = locator_of()
    both = (struck(20, seed=4, noise_db=level).sounds for level in (-40.0, 15.0))
    sizes = [sum(int(locator.locate(sound).region().sum()) for sound in sounds) for sounds in both]
    assert sizes[1] > 1.5 * sizes[0]


def test_modes_beneath_noise_count_for_little():
    # A rumble that drowns the lowest third of the modes.
    impacts, generator = struck(12, seed=4), torch.Generator().manual_seed(1)
    white = torch.fft.rfft(torch.randn(impacts.sounds.shape, generator=generator))
    white[:, white.shape[1] // 4 :] = 0
    rumble = torch.fft.irfft(white, n=impacts.sounds.shape[1])
    sounds = impacts.sounds + 60 * rumble * impacts.sounds.std() / rumble.std()
    found = [locator_of().locate(sound) for sound in sounds]
    errors = [missed(each, each.most_probable, contact) for each, contact in zip(found, impacts.contacts, strict=True)]
    assert sum(errors) / 12 < 0.02


def test_short_sounds_suffice_although_modes_cannot_be_told_apart():
    impacts, locator = struck(15, seed=8), locator_of()
    for sound, contact in zip(impacts.sounds, impacts.contacts, strict=True):
        found = locator.locate(sound[:400])
        assert missed(found, found.most_probable, contact) < 0.03
        assert found.explained_energy > 0.9


@pytest.mark.parametrize("length", [0.14, 0.22, 0.25, 0.4])
def test_another_plate_is_refused_with_the_number(length):
    impacts = struck(4, seed=6, plate=replace(PLATE, length=length, width=length / 1.3))
    locator = locator_of()
    for sound in impacts.sounds:
        assert locator.locate(sound).mismatch_ratio > 1.5 * REJECT_ABOVE
        found = locate(true_field(), sound, locator=locator)
        assert f"a mismatch ratio of {found.mismatch_ratio:.2f}" in found.refusal
        for name in ("position", "most_probable"):
            with raises(LocationError, name=name, value=found.mismatch_ratio):
                getattr(found, name)
        assert bool(found.probability.isnan().all())
        assert bool(found.distance.isfinite().all())


@pytest.mark.parametrize("noise_db", [-40.0, 0.0])
@pytest.mark.parametrize(("taps", "seed"), [(None, 6), (25, 6), (25, 5)], ids=["true", "held out", "trained on"])
def test_own_sounds_are_explained_better_than_by_noise(taps, seed, noise_db):
    for sound in struck(12, seed=seed, noise_db=noise_db).sounds:
        found = assess_match(locator_of(taps).locate(sound))
        assert found.refusal is None
        assert found.evidence > 0.0


@pytest.mark.parametrize("taps", [None, 25])
def test_a_sound_whose_modes_are_so_strong_at_no_place_has_none(taps):
    size = locator_of().gains.abs().square().mean(0).sqrt()
    for seed in range(6):
        # Each mode in a random phase, the louder the weaker it is on the plate.
        drawn = torch.randn(len(bank()), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        sound = true_field().modal_sounds(Gains((torch.view_as_complex(drawn) / size)[None]), 7200)[0].float()
        found = assess_match(locator_of(taps).locate(sound))
        # Its frequencies and dampings are the object's: only the strengths tell.
        assert found.mismatch_ratio < 0.01
        assert found.evidence <= 0.0
        with pytest.raises(LocationError):
            _ = found.position


def test_the_evidence_is_a_mean_over_the_points():
    gains, frequency = locator_of().gains[:200], bank().frequency
    values, noise = gains[7].to(torch.complex128), torch.full((len(frequency),), 1e-4, dtype=torch.float64)
    once, twice = (PredictedGains(each, 0.1 * each.abs(), frequency) for each in (gains, gains.repeat(2, 1)))
    evidence = [Likelihood(predicted, values, noise).evidence() for predicted in (once, twice)]
    assert evidence[1] == pytest.approx(evidence[0], abs=1e-3)


def test_fields_that_were_edited_and_know_no_contacts_are_located_on_too():
    impacts = struck(2, seed=44)
    for field in (true_field(), adjust_modes(true_field(), pitch=1.1)):
        assert distinct_contacts(field) is None
        assert Locator.of(field).smoothing is None
    higher = adjust_modes(replace(true_field(), origin=Origin(trained_on=("a", "b"))), pitch=1.1)
    assert distinct_contacts(higher) == 2
    # Contacts that a field does not use are not counted.
    contacts = bar_contacts(8)
    gains = elastic_field(contacts, drawn_gains(contacts, seed=1))
    used = sound_field(gains.without(torch.arange(8) < 3))
    assert [distinct_contacts(each) for each in (sound_field(gains), used, adjust_modes(used, pitch=1.1))] == [8, 5, 5]
    sound = higher.render(impacts.contacts[:1])[0]
    found = Locator.of(higher).locate(sound)
    assert missed(found, found.most_probable, impacts.contacts[0]) < 0.05


@pytest.mark.parametrize("given", [2.0, 2, np.float32(2)], ids=repr)
def test_a_force_may_be_a_number(given):
    found, expected = (locator_of().locate(SOUND, force=force) for force in (given, Force(2.0)))
    assert torch.equal(found.probability, expected.probability)


@pytest.mark.parametrize("given", ["strong", [1.0, 2.0], np.ones(1), np.ones(2), torch.ones(2), True], ids=str)
def test_what_is_not_one_force_is_refused(given):
    for find in (locate, locate_impacts):
        with raises(LocationError, name="force.expected"):
            find(locator_of().field, SOUND, force=given, locator=locator_of())


SOUND = struck(1, seed=3).sounds[0]
NOISE = torch.randn(7200, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("make", "attributes"),
    [
        (lambda: Force(0.0), {"name": "force.expected", "value": 0.0}),
        (lambda: Force(math.inf), {"name": "force.expected", "value": math.inf}),
        (lambda: Force(math.nan), {"name": "force.expected"}),
        (lambda: Force(1.0, spread_db=-1.0), {"name": "force.spread_db", "value": -1.0}),
        (lambda: locator_of().locate(torch.zeros(5000)), {"name": "sound", "value": "silence"}),
        (lambda: locator_of().locate(NOISE[:300]), {"name": "samples", "value": 300}),
        (lambda: locator_of().locate(torch.full((5000,), torch.nan)), {"name": "sound", "row": 0}),
        (lambda: locator_of().locate(NOISE), {"name": "noise", "value": pytest.approx(1.0, abs=0.5)}),
        (lambda: locator_of().locate(SOUND, highest=50.0), {"name": "modes", "value": 50.0}),
        (lambda: Locator.of(true_field(), points=torch.zeros(0, 3)), {"name": "points"}),
        (lambda: Locator.of(true_field(), points=torch.zeros(3, 2)), {"name": "points"}),
        (lambda: Locator.of(true_field(), points=torch.full((3, 3), torch.nan)), {"name": "points"}),
        (
            lambda: Locator.of(true_field(), points=torch.zeros(3, 3), directions=torch.zeros(2, 3)),
            {"name": "directions"},
        ),
        *(
            (lambda find=find: find(true_field(100), SOUND, locator=locator_of()), {"name": "locator"})
            for find in (locate, locate_impacts)
        ),
    ],
)
def test_what_cannot_be_located_is_refused(make, attributes):
    with raises(LocationError, **attributes):
        make()


def test_a_mode_that_a_field_cannot_predict_does_not_decide_the_force():
    generator = torch.Generator().manual_seed(1)
    gains, errors = torch.randn(2, 200, 8, generator=generator, dtype=torch.complex64)
    variance = torch.full((200, 8), 0.04)
    gains[:, 0], variance[:, 0] = 1e-4 * gains[:, 0], 1.0
    known = PredictedGains(gains, variance, torch.linspace(200.0, 2000.0, 8, dtype=torch.float64))
    sound = (gains[50] + 0.2 * errors[50]).to(torch.complex128).index_fill(0, torch.tensor(0), 0.0)  # at its node
    assert Likelihood(known, sound, torch.full((8,), 1e-8, dtype=torch.float64)).evidence() > 10.0
