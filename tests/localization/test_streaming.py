"""Impacts in a stream, whatever still sounds, and those on other objects, whose broad modes explain any sound."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import LocationError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.locate import REJECT_ABOVE, WARN_ABOVE, locate
from avmsf.localization.locator import Locator
from avmsf.localization.streaming import WINDOW_SECONDS, LocatedImpact, Ringing, StreamingLocalizer
from avmsf.modal.modes import ModalBank, synthesize
from factories.located_plate import TrueGains
from factories.made_fields import BANK, positional, sounding
from factories.raising import raises
from oracles.plate import Plate, plate_modes, plate_surface_points, strike

RATE = 8000.0
STRUCK = (68, 60, 102, 8, 107)
"""Points that are struck one after the other, none of which sounds like another of the field's 150."""
BEGINS = (1203, 2555, 3400, 4711, 6002)
"""Their first samples: 106 to 169 ms apart."""
FORCES = (1.0, -0.6, 2.0, 0.7, -1.0)


@cache
def locator() -> Locator:
    return Locator.of(sounding(positional(), noise=1e-3, samples=4000))


@cache
def stream(*, noise: float = 1e-3) -> Tensor:
    """Return all blows, each ringing on beneath the following ones, in noise."""
    gains = locator().gains[list(STRUCK)].to(torch.complex128) * torch.tensor(FORCES, dtype=torch.float64)[:, None]
    sounds = synthesize(gains, BANK.frequency, BANK.damping, samples=4000, sample_rate=RATE)
    total = torch.zeros(BEGINS[-1] + 4000, dtype=torch.float64)
    for begin, sound in zip(BEGINS, sounds, strict=True):
        total[begin : begin + 4000] += sound
    level = noise * float(sounds.abs().max())
    return total + level * torch.randn(len(total), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def heard(listener: StreamingLocalizer, sound: Tensor) -> list[LocatedImpact]:
    return [blow for part in torch.split(sound, 100) for blow in listener.process(part)]


def spot(blow: LocatedImpact) -> int:
    return blow.map.most_probable


def test_every_blow_is_found_while_earlier_ones_ring() -> None:
    blows = heard(StreamingLocalizer(locator(), sample_rate=RATE), stream())
    assert [spot(blow) for blow in blows] == list(STRUCK)
    # The first swing of a sine stands out of the noise within two samples.
    assert [round(blow.seconds * RATE) for blow in blows] == pytest.approx(BEGINS, abs=2)
    # What rings of earlier blows is a tenth and more of a faint one's energy: left in it, less would be explained.
    assert min(blow.map.explained_energy for blow in blows) > 0.98
    assert {blow.final for blow in blows} == {True}
    assert [blow.map.force for blow in blows] == pytest.approx(FORCES, rel=0.05)
    assert [blow.used_seconds for blow in blows] == pytest.approx([WINDOW_SECONDS] * 5)
    assert min(blow.latency for blow in blows) >= WINDOW_SECONDS


def test_blocks_do_not_matter() -> None:
    whole = StreamingLocalizer(locator()).process(stream())
    generator = torch.Generator().manual_seed(1)
    lengths, ragged = torch.randint(0, 300, (200,), generator=generator).tolist(), StreamingLocalizer(locator())
    blows, begin = [], 0
    for length in [*lengths, len(stream())]:
        blows += ragged.process(stream()[begin : begin + length])
        begin += length
    assert [blow.seconds for blow in blows] == [blow.seconds for blow in whole]
    for one, other in zip(blows, whole, strict=True):
        assert torch.equal(one.map.probability, other.map.probability)


def test_a_later_answer_rests_on_more() -> None:
    blows = heard(StreamingLocalizer(locator(), later=0.12), stream(noise=3e-3))
    first = [blow for blow in blows if not blow.final]
    final = [blow for blow in blows if blow.final]
    assert [spot(blow) for blow in final] == list(STRUCK)
    assert [blow.seconds for blow in final] == [blow.seconds for blow in first]
    # The second blow was cut short by the third, 106 ms later; the others had their time.
    assert [blow.used_seconds for blow in final] == pytest.approx([0.12, 0.104, 0.12, 0.12, 0.12], abs=0.006)


def test_nothing_grows_with_time_nor_beyond_the_fields_own_sounds() -> None:
    short = StreamingLocalizer(Locator.of(replace(locator().field, samples=800)), window=0.05, later=3.0)
    assert (short.window, short.later) == (400, 800)
    listener = StreamingLocalizer(locator(), later=0.2)
    sizes = []
    for _ in range(3):
        heard(listener, stream())
        sizes.append([len(each) for each in (listener.recent, listener.residual, listener.ringing)])
    assert sizes[0] == sizes[1] == sizes[2]
    assert len(listener.waiting) < listener.hop
    assert listener.clock + len(listener.waiting) == 3 * len(stream())


def test_an_offset_and_rumble_are_not_heard() -> None:
    times = torch.arange(len(stream()), dtype=torch.float64) / RATE
    loudest = float(stream().abs().max())
    disturbed = stream() + 0.5 * loudest + 0.2 * loudest * torch.sin(2 * torch.pi * 1.5 * times)
    blows = heard(StreamingLocalizer(locator()), disturbed)
    # The filter starts with the stream, and its own start is a jump; it is over before the first blow.
    found = [spot(blow) for blow in blows if blow.seconds > 0.1]
    assert found == list(STRUCK)


@pytest.mark.parametrize("kind", [Tensor.numpy, Tensor.tolist])
def test_blocks_and_sounds_are_lists_or_arrays_as_well(kind) -> None:
    listener, sound = StreamingLocalizer(locator()), stream()[BEGINS[0] :][:1000]
    blows = [blow for part in torch.split(stream(), 500) for blow in listener.process(kind(part))]
    assert [spot(blow) for blow in blows] == list(STRUCK)
    assert torch.equal(locator().locate(kind(sound)).probability, locator().locate(sound).probability)


def test_what_does_not_belong_to_the_object_is_counted_and_the_next_blow_found() -> None:
    listener = StreamingLocalizer(locator())
    burst = torch.zeros(800, dtype=torch.float64)
    burst[200:480] = torch.randn(280, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    first = heard(listener, 1e-4 * torch.randn(800, dtype=torch.float64, generator=torch.Generator().manual_seed(4)))
    foreign = heard(listener, 10 * burst)
    assert first == []
    assert listener.rejected + len(foreign) == 1
    assert all(blow.map.explained_energy < 0.3 for blow in foreign)
    assert [spot(blow) for blow in heard(listener, stream())] == list(STRUCK)


def test_ringing_is_followed_and_fitted_exactly() -> None:
    size = torch.ones(len(BANK))
    modes = Ringing(BANK, size, sample_rate=RATE, window=480)
    amplitudes = torch.complex(*torch.randn(2, len(BANK), generator=torch.Generator().manual_seed(0)).double())
    sound = synthesize(amplitudes[None], BANK.frequency, BANK.damping, samples=1200, sample_rate=RATE)[0]
    assert torch.allclose(modes.render(amplitudes, 1200), sound, atol=1e-9)
    assert torch.allclose(modes.render(modes.after(amplitudes, 300), 900), sound[300:], atol=1e-9)
    assert torch.allclose(modes.fit(sound[:480], 0.0), amplitudes, atol=1e-6)
    # Noise alone, as loud as it is said to be, is no ringing.
    assert not modes.fit(1e-3 * sound[:480], 1.0).abs().any()


def test_modes_that_an_edit_made_silent_are_not_followed() -> None:
    high = adjust_modes(locator().field, pitch=2.5)
    audible = int(high.audible.sum())
    assert 0 < audible < len(BANK)
    listener = StreamingLocalizer(Locator.of(high))
    assert len(listener.ringing) == audible
    sound = torch.cat([torch.zeros(800), high.render(locator().points[:1])[0]]).double()
    noise = 1e-4 * torch.randn(len(sound), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    (blow,) = heard(listener, sound + noise)
    assert round(blow.seconds * RATE) == pytest.approx(800, abs=4)


@pytest.mark.parametrize(
    ("name", "value", "given"),
    [("sample_rate", 44100.0, {}), ("window", 0.0, {}), ("window", 0.01, {}), ("later", 0.05, {"window": 0.06})],
)
def test_streams_that_cannot_be_located_are_refused(name, value, given) -> None:
    with raises(LocationError, name=name, value=value):
        StreamingLocalizer(locator(), **{**given, name: value})
    with raises(LocationError, name="field", value=0):
        StreamingLocalizer(replace(locator(), field=adjust_modes(locator().field, pitch=1000.0)))
    listener = StreamingLocalizer(locator())
    with raises(LocationError, name="block"):
        listener.process(torch.tensor([0.0, float("nan")]))
    with raises(LocationError, name="block", value=[100, 2]):
        listener.process(np.zeros((100, 2)))
    assert listener.clock + len(listener.waiting) == 0


PLATE_RATE, SECONDS, LENGTH = 44100.0, 0.4, 0.24
HIGHEST = {"wood": 6000.0, "plastic": 3000.0}


def plate(material: str, length: float = LENGTH) -> Plate:
    sizes = {"length": length, "width": length / 1.44, "thickness": 0.003}
    if material == "wood":
        return Plate(**sizes, young=1.1e10, density=750.0, poisson=0.25, alpha=60.0, beta=2e-6)
    return Plate(**sizes, young=1.4e9, density=1070.0, poisson=0.35, alpha=30.0, beta=1e-6)


@cache
def damped_field(material: str) -> SoundField:
    own = plate(material)
    modes = plate_modes(own, plate_surface_points(own, 1), highest=HIGHEST[material])
    gains = TrueGains(plate_surface_points(own, 400).float(), plate=own, highest=HIGHEST[material])
    bank, samples = ModalBank(modes.frequency, modes.damping), round(PLATE_RATE * SECONDS)
    return sounding(gains, bank=bank, noise=1e-3, rate=PLATE_RATE, samples=samples, origin=Origin())


@cache
def damped_locator(material: str) -> Locator:
    return Locator.of(damped_field(material))


def damped_blows(material: str, *, length: float = LENGTH, heard_by: str, noise_db: float = -40.0) -> Tensor:
    """Return eight blows on a plate, up to the highest frequency that the field of material `heard_by` knows."""
    recorder = {"sample_rate": PLATE_RATE, "seconds": SECONDS, "seed": 0, "noise_db": noise_db}
    return strike(plate(material, length), 8, highest=HIGHEST[heard_by], **recorder).sounds


FOREIGN = [("wood", "wood", 0.2), ("wood", "wood", 0.33), ("plastic", "wood", 0.2), ("plastic", "plastic", 0.2)]
"""Material of the field, and material and length of the plate that is struck; the fields' own are .24 m long."""


def recorded(sound: torch.Tensor) -> torch.Tensor:
    """Return a sound with a tenth of a second of near silence before it, as loud as others."""
    whole = torch.cat([torch.zeros(round(0.1 * PLATE_RATE)), sound / sound.abs().max()])
    return whole + 1e-4 * torch.randn(len(whole), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("material", "other", "length"), FOREIGN)
def test_broad_modes_explain_a_stranger_and_it_is_refused(material, other, length):
    locator, shares = damped_locator(material), []
    for sound in damped_blows(other, length=length, heard_by=material):
        found = locator.locate(sound)
        shares.append(found.modal_energy)
        assert found.mismatch_ratio > REJECT_ABOVE
        assert "mismatch ratio" in locate(damped_field(material), recorded(sound), locator=locator).refusal
    # What the modes explain tells nothing here: of strangers half and more.
    assert max(shares) > 0.5


@pytest.mark.parametrize("material", ["wood", "plastic"])
@pytest.mark.parametrize("noise_db", [-40.0, 0.0])
def test_own_sounds_of_damped_plates_fit(material, noise_db):
    for sound in damped_blows(material, heard_by=material, noise_db=noise_db):
        assert damped_locator(material).locate(sound).mismatch_ratio <= WARN_ABOVE


@pytest.mark.parametrize(("material", "other", "length"), FOREIGN)
def test_a_stream_refuses_strangers_or_doubts_them(material, other, length):
    listener = StreamingLocalizer(damped_locator(material))
    foreign = damped_blows(other, length=length, heard_by=material)[:4]
    blows = [blow for sound in foreign for blow in listener.process(recorded(sound))]
    assert listener.rejected + len(blows) == len(foreign)
    # In 40 ms broad modes are told apart less than in all of a sound.
    assert len(blows) <= 1
    assert all("mismatch ratio" in note for blow in blows for note in blow.map.notes)
    assert "mismatch ratio" in listener.refusal
    sounds = damped_blows(material, heard_by=material)[:4]
    assert [each.map.notes for sound in sounds for each in listener.process(recorded(sound))] == [()] * 4


@pytest.mark.parametrize("seconds", [0.04, 0.4])
def test_noise_is_no_part_of_a_sounds_energy(seconds):
    field = damped_field("wood")
    both = (damped_blows("wood", heard_by="wood", noise_db=level) for level in (-60.0, 0.0))
    quiet, loud = (sounds[:, : round(seconds * PLATE_RATE)] for sounds in both)
    modes = Extractor(field.bank, sample_rate=PLATE_RATE, samples=quiet.shape[1])
    for clear, noisy in zip(quiet, loud, strict=True):
        energy = float(clear.double().square().sum())
        assert modes.extract(clear, color=field.residual).energy == pytest.approx(energy, rel=1e-3)
        # The estimate rests on 5 frames in the shorter sounds, and scatters by a twelfth of the noise.
        noise = float(noisy.double().square().sum()) - energy
        left = modes.extract(noisy, color=field.residual).energy
        assert left == pytest.approx(energy, abs=0.25 * noise)


def test_a_sound_beneath_noise_is_no_less_than_its_modes() -> None:
    # Noise 15 dB up in 40 ms: what it leaves is now and then estimated to be less than modes explain in any tune, and
    # measured by that all of them would explain all.
    field, locator, judged = damped_field("wood"), damped_locator("wood"), 0
    drowned = damped_blows("wood", length=0.2, heard_by="wood", noise_db=15.0)[:, : round(0.04 * PLATE_RATE)]
    modes = Extractor(field.bank, sample_rate=PLATE_RATE, samples=drowned.shape[1])
    for sound in drowned:
        estimated = modes.extract(sound, color=field.residual)
        if 0.3 < estimated.energy / estimated.fitted < 0.6:
            found, judged = locator.locate(sound), judged + 1
            assert 0.0 < found.null_energy < 1.0
    assert judged
