"""`avmsf edit`: from a field file to another, with pictures, sounds and words."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import soundfile
import torch

from avmsf._utils.progress import ProgressDisplay
from avmsf.cli import main
from avmsf.cli.edit_report import contact_of_sounds
from avmsf.cli.paths import OutputError
from avmsf.editing.material import RATIO_ONLY, change_material, infer_material, rayleigh_damping
from avmsf.editing.modal_edit import EDITS, adjust_modes
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError, EditError
from avmsf.fem.material import CERAMIC, GLASS, STEEL, WOOD
from avmsf.field.gains.kernels import Sites
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.made_audio import save_audio
from factories.made_fields import FIELDS, mixture, places
from factories.raising import raises
from factories.settings import sets
from factories.verbs import run_verb

Streams = pytest.CaptureFixture[str]
RATE = 8000.0
PLACES = places(5, seed=3)
FREQUENCY = torch.tensor([390.0, 850.0, 1300.0, 1360.0, 2300.0], dtype=torch.float64)


def ceramic() -> SoundField:
    """Return a field whose dampings are near to ceramic's."""
    damping = rayleigh_damping(2 * math.pi * FREQUENCY, CERAMIC) * torch.tensor([1.1, 1.0, 0.9, 1.2, 1.0])
    bank, phase = ModalBank(FREQUENCY, damping), torch.zeros(5, dtype=torch.float64)
    return SoundField(
        bank, FIELDS["positional"](), phase, Residual(torch.full((9,), 1e-6)), RATE, 2400, Origin("plate")
    )


@pytest.fixture
def field(tmp_path: Path) -> Path:
    save(ceramic(), tmp_path / "plate.safetensors")
    return tmp_path / "plate.safetensors"


def edited(field: Path, *words: str, name: str = "new") -> SoundField:
    output = field.with_name(f"{name}.safetensors")
    assert run_verb("edit", str(field), "--output", str(output), *words) == 0
    return load(output)


def expect_same(found: SoundField, expected: SoundField) -> None:
    assert torch.equal(found.bank.frequency, expected.bank.frequency)
    assert torch.equal(found.bank.damping, expected.bank.damping)
    assert torch.equal(found.render(PLACES), expected.render(PLACES))


def test_a_material_by_its_name_with_pictures_sounds_and_numbers(field: Path, capsys: Streams) -> None:
    folder = field.parent / "look"
    words = ["--to", "Wood", "--from", "ceramic", "--scale", "2", "--plots", str(folder), "--json"]
    new = edited(field, *words)
    out, err = capsys.readouterr()
    expect_same(new, change_material(ceramic(), CERAMIC, WOOD, size=2.0))
    told = json.loads(out)
    assert told["edits"][0]["to"]["name"] == "wood"
    assert [row["frequency_after"] for row in told["modes"]] == pytest.approx(new.bank.frequency.tolist())
    assert [row["frequency_before"] for row in told["modes"]] == FREQUENCY.tolist()
    assert [row["t60_after"] for row in told["modes"]] == pytest.approx((math.log(1000) / new.bank.damping).tolist())
    change = 20 * torch.log10((new.gains(2 * PLACES) / ceramic().gains(PLACES))[0].abs())
    assert [row["level_change_db"] for row in told["modes"]] == pytest.approx(change.tolist(), abs=1e-4)
    assert "Poisson's ratio changes from 0.19 to 0.25" in err
    for name in ("modes.png", "spectrograms.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    before, after = (soundfile.read(folder / f"{name}.wav")[0] for name in ("before", "after"))
    # The loudest place of the old object, and the same one of the new, twice as large; both by one factor.
    levels = [float(abs(each).max()) for each in (before, after)]
    assert max(levels) == pytest.approx(10 ** (-1 / 20), rel=1e-6)
    points = ceramic().gain_field.points[::2].double()
    ratios = new.render(2 * points).abs().amax(1) / ceramic().render(points).abs().amax(1)
    assert float((ratios - levels[1] / levels[0]).abs().min()) < 1e-4 * levels[1] / levels[0]


def notes(capsys: Streams) -> list[str]:
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]


def test_constants_stand_in_place_of_the_tables(field: Path) -> None:
    new = edited(field, "--from", "ceramic", *sets("material.young=1e10 material.beta=2e-7 material.law=ratio-only"))
    custom = replace(CERAMIC, young=1e10, beta=2e-7)
    expect_same(new, change_material(ceramic(), CERAMIC, custom, law=RATIO_ONLY))
    other = edited(field, "--to", "glass", "--from", "ceramic", "--set", "material.density=5000", name="other")
    expect_same(other, change_material(ceramic(), CERAMIC, replace(GLASS, density=5000.0)))


def test_materials_that_damp_alike_are_both_named() -> None:
    high = ceramic()
    frequency = torch.linspace(5000, 9000, len(high.bank), dtype=torch.float64)
    damping = 0.5 * (CERAMIC.alpha + CERAMIC.beta * (2 * torch.pi * frequency).square())
    material, words = infer_material(replace(high, bank=ModalBank(frequency, damping)), option="--from")
    assert material.name == "ceramic"
    assert "iron" in words


def test_the_old_material_is_told_by_the_dampings_or_the_last_edit(field: Path, capsys: Streams) -> None:
    wood = edited(field, "--to", "wood", name="wood")
    assert wood.origin.report[EDITS][0]["from"]["name"] == "ceramic"
    printed = capsys.readouterr().err
    assert "ceramic assumed" in printed
    assert "factor of 1.1" in printed
    assert "fits equally well" not in printed
    edited(field.with_name("wood.safetensors"), "--pitch", "1.5", name="high")
    back = edited(field.with_name("high.safetensors"), "--to", "ceramic", name="back")
    assert back.origin.report[EDITS][2]["from"]["name"] == "wood"
    assert "wood, from the last material edit" in capsys.readouterr().err
    strange = replace(ceramic(), bank=ModalBank(FREQUENCY, FREQUENCY))
    save(strange, field)
    with raises(AvmsfError, name="--from"):
        edited(field, "--to", "wood")


def test_sliders_follow_the_material_and_call_modes_by_their_old_frequencies(field: Path) -> None:
    sliders = ["--pitch", "1.2", "--decay", "0.5", "--brightness", "3", "--mode-db", "852", "-inf"]
    new = edited(field, "--to", "wood", "--from", "ceramic", *sliders, "--mode-db", "2300", "6")
    levels = [0.0, -math.inf, 0.0, 0.0, 6.0]
    expected = adjust_modes(
        change_material(ceramic(), CERAMIC, WOOD), pitch=1.2, decay=0.5, brightness_db=3.0, gains_db=levels
    )
    expect_same(new, expected)
    for option in ("--mode-db", "--mode-pitch", "--mode-decay"):
        with raises(AvmsfError, name=option, value=1000.0) as caught:
            edited(field, option, "1000", "3")
        assert "850 Hz" in str(caught.value)


def test_single_modes_have_a_pitch_and_a_decay_of_their_own(field: Path) -> None:
    words = ["--pitch", "1.2", "--mode-pitch", "850", "0.5", "--mode-pitch", "2300", "1.5", "--mode-decay", "1300", "4"]
    factors = {"pitch": [1.2, 0.6, 1.2, 1.2, 1.2 * 1.5], "decay": [1.0, 1.0, 4.0, 1.0, 1.0]}
    expect_same(edited(field, *words), adjust_modes(ceramic(), **factors))
    expect_same(edited(field, "--mode-decay", "390", "2"), adjust_modes(ceramic(), decay=[2.0, 1.0, 1.0, 1.0, 1.0]))
    expect_same(edited(field, "--mode-pitch", "390", "2"), adjust_modes(ceramic(), pitch=[2.0, 1.0, 1.0, 1.0, 1.0]))


def test_silent_modes_are_said(field: Path, capsys: Streams) -> None:
    edited(field, "--pitch", "3")
    out, _ = capsys.readouterr()
    assert "note: 2 of 5 modes, from 4080 Hz to 6900 Hz, are silent" in out
    assert "only residual noise" not in out
    edited(field, "--pitch", "30", "--json")
    out, err = capsys.readouterr()
    assert "only residual noise" in err
    told = json.loads(out)
    assert told["silent_modes"] == 5
    assert told["edits"][0]["silent_hertz"] == pytest.approx((30 * FREQUENCY).tolist())
    assert [row["silent"] for row in told["modes"]] == [True] * 5
    assert {row["level_change_db"] for row in told["modes"]} == {None}


def test_towards_a_recording_and_an_interrupted_edit_goes_on(
    field: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = adjust_modes(ceramic(), pitch=1.3).render(PLACES[:1])[0]
    soundfile.write(field.with_name("like.wav"), torch.cat([torch.zeros(800), target]).numpy() / 50, int(RATE))
    words = [
        "--like",
        str(field.with_name("like.wav")),
        *sets("guide.steps=4 guide.contacts_per_step=2 guide.preview_every=2"),
    ]
    whole = edited(field, *words, "--json", name="whole")
    told = json.loads(capsys.readouterr().out)
    assert told["edits"][0]["reference"] == "like.wav"
    assert float((whole.bank.frequency / FREQUENCY).median()) == pytest.approx(1.3, rel=0.1)
    shown = ProgressDisplay.step

    def impatient(bar: ProgressDisplay, stage: str, done: int, total: int, message: str) -> None:
        shown(bar, stage, done, total, message)
        if done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressDisplay, "step", impatient)
    assert main(["edit", str(field), "--output", str(field.with_name("part.safetensors")), *words]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "avmsf edit: interrupted; repeat the command to continue"
    assert not field.with_name("part.safetensors").exists()
    preview, rate = soundfile.read(field.with_name("part.safetensors.preview.wav"))
    assert (len(preview), rate) == (2400, RATE)
    state = field.with_name("part.safetensors.checkpoint")
    kept = state.read_bytes()
    edited(field, "--pitch", "2", name="part")
    assert state.read_bytes() == kept
    steps = []
    monkeypatch.setattr(ProgressDisplay, "step", lambda bar, stage, done, *rest: steps.append(done))
    expect_same(edited(field, *words, name="part"), whole)
    assert steps == [3, 4]
    assert not list(field.parent.glob("*.preview.wav")) + list(field.parent.glob("*.checkpoint"))


def test_towards_a_materials_sound(field: Path, capsys: Streams) -> None:
    quick = [*sets("guide.steps=2 guide.contacts_per_step=2 guide.preview_every=0")]
    wood = edited(field, "--like-material", "Wood", *quick, name="wood")
    assert "ceramic assumed" in capsys.readouterr().err
    (told,) = wood.origin.report[EDITS]
    assert (told["edit"], told["reference"]) == ("guided", "wood")
    ringing = wood.bank.damping / ceramic().bank.damping
    assert float(ringing.median()) > 3.0
    # What it is of is what it was made before, and what is made of it before is what the sound is led on from.
    heard = Reference.of_material(change_material(ceramic(), GLASS, WOOD), WOOD, STEEL, seed=3).describe()
    words = ["--from", "glass", "--to", "wood", "--pitch", "1", "--like-material", "steel", "--set", "guide.seed=3"]
    both = edited(field, *words, *quick, name="both")
    assert [each["edit"] for each in both.origin.report[EDITS]] == ["change_material", "guided"]
    assert {name: both.origin.report[EDITS][1][name] for name in heard} == heard
    assert main(["info", str(field.with_name("both.safetensors"))]) == 0
    out = capsys.readouterr().out
    assert "edited     change_material, from glass to wood, law displacement" in out
    assert "edited     guided, towards 'steel', pitch " in out
    assert ", steps 2" in out
    assert "preview_every" not in out


def test_the_loudest_place_is_that_of_both_parts_of_the_gains(field: Path) -> None:
    values = torch.zeros(3, 5, dtype=torch.complex128)
    values[0], values[1] = 1.0, 3.0j
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64)
    alike = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(3, 3)
    gains = replace(mixture(Sites(corners, alike), values, directional=False), points=corners.float())
    loud = replace(ceramic(), gain_field=gains)
    assert contact_of_sounds(loud, None).tolist() == pytest.approx([0.1, 0.0, 0.0])


class Echo:
    """A model of sound that answers every prompt with the same ring, whatever it is given."""

    name, sample_rate, channels = "echo", RATE, 1
    device, dtype = torch.device("cpu"), torch.float32

    def __init__(self, answer: torch.Tensor) -> None:
        self.answer, self.asked = answer, []

    def describe(self) -> dict[str, str]:
        return {"model": self.name}

    def encode(self, waveforms: torch.Tensor) -> torch.Tensor:
        return waveforms

    def decode(self, latents: torch.Tensor, *, samples: int) -> torch.Tensor:
        return latents[..., :samples]

    def embed(self, prompt: str, negative: str | None, *, seconds: float) -> str:
        self.asked.append((prompt, negative))
        return prompt

    def generate(self, prompt: str, *, seconds: float, seed: int, negative: str | None) -> torch.Tensor:
        return 0.1 * self.answer[: round(seconds * RATE)]

    def denoised(
        self, latents: torch.Tensor, level: torch.Tensor, conditioning: str, *, guidance: float
    ) -> torch.Tensor:
        return self.answer.expand_as(latents)


def test_options_that_would_do_nothing_are_refused(field: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(name: str, *words: str) -> None:
        with raises(EditError, name=name):
            edited(field, *words)

    monkeypatch.setattr("avmsf.field.store.load", lambda path: pytest.fail("the field was loaded"))
    refused("guide", "--pitch", "2", *sets("guide.steps=9"))
    refused("parameters", "--pitch", "2", *sets("parameters=published"))
    refused("prompt", "--like", "like.wav", *sets("prompt.negative=wood"))
    refused("--model", "--like", "like.wav", "--model", "nowhere")
    refused("prompt", "--pitch", "2", *sets("prompt.distillation.denoising=3"))
    refused("material.law", "--pitch", "2", *sets("material.law=ratio-only"))
    refused("material.law", "--like-material", "wood", *sets("material.law=velocity"))
    refused("--position", "--pitch", "2", "--position", "0", "0", "0")


def test_settings_of_a_model_that_cannot_be_meant_are_refused_before_it_is_loaded(
    field: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StableAudio, "load", lambda *_, **__: pytest.fail("a model was loaded"))
    for setting, value in (
        ("distillation.guidance", -5.0),
        ("distillation.denoising", 0),
        ("distillation.batch", 0),
        ("model_seconds", 0.0),
        ("model_seconds", math.inf),
    ):
        name = "prompt.model_seconds" if setting == "model_seconds" else setting.removeprefix("distillation.")
        with raises(EditError, name=name, value=value):
            edited(field, "--prompt", "a bell", "--set", f"prompt.{setting}={json.dumps(value)}")


def test_towards_words(field: Path, monkeypatch: pytest.MonkeyPatch, capsys: Streams) -> None:
    model = Echo(adjust_modes(ceramic(), pitch=1.02).render(PLACES[:1])[0])
    loaded = []

    def load_model(source: str, **settings: object) -> Echo:
        loaded.append((source, settings))
        return model

    monkeypatch.setattr(StableAudio, "load", load_model)
    words = ["--prompt", "a bell", "--model", "here", *sets("guide.steps=40 guide.contacts_per_step=2")]
    words += sets("prompt.negative=wood prompt.model_seconds=1 parameters=published")
    alone = field.with_name("generated.wav")
    new = edited(field, *words, "--set", f"prompt.generated={alone}")
    assert soundfile.info(str(alone)).samplerate == RATE
    assert new.origin.report[EDITS][0]["parameters"] == "published"
    assert loaded == [("here", {"seconds": 1.0, "device": None})]
    assert model.asked[0] == ("a bell", "wood")
    assert new.origin.report[EDITS][0]["prompt"] == "a bell"
    # The answer is 2 % higher.
    assert 1.005 < float((new.bank.frequency / FREQUENCY).median()) < 1.035
    assert "loss" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:`torch.nn.utils.weight_norm` is deprecated:FutureWarning")
def test_towards_words_by_a_saved_model_and_an_interrupted_edit_goes_on(
    field: Path, monkeypatch: pytest.MonkeyPatch, capsys: Streams
) -> None:
    pytest.importorskip("diffusers", reason="needs pip install 'avmsf[text]'")
    pytest.importorskip("transformers")
    model = save_audio(field.with_name("tiny-audio"))
    words = ["--prompt", "a wooden bowl is hit", "--model", str(model), *sets("prompt.device=cpu denoising=2")]
    words += [*sets("guide.steps=2 guide.contacts_per_step=2 guide.preview_every=1"), "--json"]

    def edit_to(name: str) -> int:
        return main(["edit", str(field), "--output", str(field.with_name(f"{name}.safetensors")), *words])

    assert edit_to("whole") == 0
    (told,) = json.loads(capsys.readouterr().out)["edits"]
    assert (told["edit"], told["prompt"], told["model"]) == ("guided", "a wooden bowl is hit", "tiny-audio")
    whole = load(field.with_name("whole.safetensors"))
    assert bool((whole.bank.frequency != FREQUENCY).all())
    shown = ProgressDisplay.step
    steps = []

    def impatient(bar: ProgressDisplay, stage: str, done: int, total: int, message: str) -> None:
        shown(bar, stage, done, total, message)
        steps.append(done)
        if steps == [1]:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressDisplay, "step", impatient)
    assert edit_to("part") == 130
    assert edit_to("part") == 0
    assert steps == [1, 2]
    expect_same(load(field.with_name("part.safetensors")), whole)


def test_what_cannot_be_done_is_said_before_any_work(field: Path, capsys: Streams) -> None:
    def refused(name: str | None, value: object, *words: str, file: str | None = None) -> None:
        with raises(AvmsfError, file=file, name=name, value=value):
            edited(field, *words)
        assert not field.with_name("new.safetensors").exists()

    refused("options", None)
    refused("--from", None, "--from", "wood")
    refused("--prompt", ("--prompt", "--like"), "--prompt", "a bell", "--like", "like.wav")
    refused("--like", ("--like", "--like-material"), "--like-material", "wood", "--like", "like.wav")
    refused("--like-material", "cheese", "--like-material", "cheese")
    refused("prompt", "  ", "--prompt", "  ")
    refused("--to", "cheese", "--to", "cheese")
    refused("young", -1.0, "--from", "ceramic", "--set", "material.young=-1")
    refused("size", 0.0, "--from", "ceramic", "--scale", "0")
    refused("pitch", 0.0, "--pitch", "0")
    refused(None, None, "--like", str(field.with_name("nowhere.wav")), file="nowhere.wav")
    refused("steps", 0, "--like", "like.wav", "--set", "guide.steps=0")
    assert main(["edit", str(field), "--output", str(field), "--pitch", "2"]) == 2
    assert capsys.readouterr().err.startswith(f"avmsf edit: {field}")
    far = ["--pitch", "2", "--plots", str(field.with_name("look")), "--position", "100", "0", "0"]
    with pytest.raises(OutputError):
        edited(field, *far)
