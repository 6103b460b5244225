"""Blows on other objects: refused by fields whose modes are so broad that they explain any sound in their band."""

from functools import cache

import pytest
import torch
from torch import Tensor

from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.locate import REJECT_ABOVE, WARN_ABOVE, locate, locate_impacts
from avmsf.localization.locator import Locator
from avmsf.localization.streaming import StreamingLocalizer
from avmsf.modal.modes import ModalBank
from factories.located_plate import TrueGains
from factories.made_fields import sounding
from oracles.plate import Plate, plate_modes, plate_surface_points, sample_contacts, strike

RATE, SECONDS, LENGTH = 44100.0, 0.4, 0.24
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
    bank, samples = ModalBank(modes.frequency, modes.damping), round(RATE * SECONDS)
    return sounding(gains, bank=bank, noise=1e-3, rate=RATE, samples=samples, origin=Origin())


@cache
def damped_locator(material: str) -> Locator:
    return Locator.of(damped_field(material))


def damped_blows(material: str, *, length: float = LENGTH, heard_by: str, noise_db: float = -40.0) -> Tensor:
    """Return eight blows on a plate, up to the highest frequency that the field of material `heard_by` knows."""
    generator = torch.Generator().manual_seed(0)
    struck = plate(material, length)
    contacts = sample_contacts(struck, 8, generator=generator)
    recorder = {"sample_rate": RATE, "seconds": SECONDS, "generator": generator, "noise_db": noise_db}
    return strike(struck, contacts, highest=HIGHEST[heard_by], **recorder).sounds


FOREIGN = [("wood", "wood", 0.2), ("wood", "wood", 0.33), ("plastic", "wood", 0.2), ("plastic", "plastic", 0.2)]
"""Material of the field, and material and length of the plate that is struck; the fields' own are .24 m long."""


def recorded(sound: torch.Tensor) -> torch.Tensor:
    """Return a sound with a tenth of a second of near silence before it, as loud as others."""
    whole = torch.cat([torch.zeros(round(0.1 * RATE)), sound / sound.abs().max()])
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
def test_of_several_blows_the_strangers_are_left_out(material, other, length):
    own = damped_blows(material, heard_by=material)[0]
    foreign = damped_blows(other, length=length, heard_by=material)[1]
    both = torch.cat([recorded(own), recorded(foreign)])
    found = locate_impacts(damped_field(material), both, locator=damped_locator(material))
    assert [round(seconds, 2) for seconds, _ in found] == [0.1]


@pytest.mark.parametrize(("material", "other", "length"), FOREIGN)
def test_a_stream_refuses_strangers_or_doubts_them(material, other, length):
    listener, foreign = (
        StreamingLocalizer(damped_locator(material)),
        damped_blows(other, length=length, heard_by=material)[:4],
    )
    blows = [blow for sound in foreign for blow in listener.process(recorded(sound))]
    assert listener.rejected + len(blows) == len(foreign)
    # In 40 ms broad modes are told apart less than in all of a sound.
    assert len(blows) <= 1
    assert all("mismatch ratio" in note for blow in blows for note in blow.map.notes)
    assert "mismatch ratio" in listener.refusal
    own = [
        each for sound in damped_blows(material, heard_by=material)[:4] for each in listener.process(recorded(sound))
    ]
    assert [each.map.notes for each in own] == [()] * 4


@pytest.mark.parametrize("seconds", [0.04, 0.4])
def test_noise_is_no_part_of_a_sounds_energy(seconds):
    field = damped_field("wood")
    quiet, loud = (
        damped_blows("wood", heard_by="wood", noise_db=level)[:, : round(seconds * RATE)] for level in (-60.0, 0.0)
    )
    modes = Extractor(field.bank, sample_rate=RATE, samples=quiet.shape[1])
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
    drowned = damped_blows("wood", length=0.2, heard_by="wood", noise_db=15.0)[:, : round(0.04 * RATE)]
    modes = Extractor(field.bank, sample_rate=RATE, samples=drowned.shape[1])
    for sound in drowned:
        estimated = modes.extract(sound, color=field.residual)
        if 0.3 < estimated.energy / estimated.fitted < 0.6:
            found, judged = locator.locate(sound), judged + 1
            assert 0.0 < found.null_energy < 1.0
    assert judged
