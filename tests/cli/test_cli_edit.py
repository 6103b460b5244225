"""Edits from the command line, with their curve of CLAP."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
import torch
from matplotlib.figure import Figure

from avmsf._utils.progress import ProgressDisplay
from avmsf.cli import main
from avmsf.cli.edits import contact_of_sounds
from avmsf.cli.paths import OutputError
from avmsf.cli.report import field_lines
from avmsf.editing.material import change_material, rayleigh_damping
from avmsf.editing.modal_edit import EDITS, adjust_modes
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError
from avmsf.evaluation.clap import Clap
from avmsf.fem.material import CERAMIC, GLASS, STEEL, WOOD
from avmsf.field.gains.kernels import Sites
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.modal.modes import ModalBank
from factories.made_clap import save_clap
from factories.made_fields import FIELDS, mixture, places, sounding
from factories.raising import raises
from factories.verbs import Streams, results_of, run_verb, sets

RATE = 8000.0
PLACES = places(5, seed=3)
FREQUENCY = torch.tensor([390.0, 850.0, 1300.0, 1360.0, 2300.0], dtype=torch.float64)


def ceramic() -> SoundField:
    """Return a field whose dampings are near to ceramic's."""
    damping = rayleigh_damping(2 * math.pi * FREQUENCY, CERAMIC) * torch.tensor([1.1, 1.0, 0.9, 1.2, 1.0])
    return sounding(FIELDS["positional"](), bank=ModalBank(FREQUENCY, damping), noise=1e-6, rate=RATE, samples=2400)


@pytest.fixture
def field(tmp_path: Path) -> Path:
    save(ceramic(), tmp_path / "plate.safetensors")
    return tmp_path / "plate.safetensors"


def edited(field: Path, *words: str, name: str = "new") -> SoundField:
    output = field.with_name(f"{name}.safetensors")
    assert run_verb("edit", str(field), "--output", str(output), "--overwrite", *words) == 0
    return load(output)


def expect_same(found: SoundField, expected: SoundField) -> None:
    assert torch.equal(found.bank.frequency, expected.bank.frequency)
    assert torch.equal(found.bank.damping, expected.bank.damping)
    assert torch.equal(found.render(PLACES), expected.render(PLACES))


def interrupt_at(monkeypatch: pytest.MonkeyPatch, step: int) -> list[int]:
    """Let Ctrl-C come once, as a step is shown; return the steps that are shown."""
    shown, steps = ProgressDisplay.step, list[int]()

    def impatient(bar: ProgressDisplay, stage: str, done: int, total: int, message: str) -> None:
        shown(bar, stage, done, total, message)
        steps.append(done)
        if done == step and steps.count(step) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressDisplay, "step", impatient)
    return steps


def test_a_material_by_its_name_with_pictures_sounds_and_numbers(field: Path, capsys: Streams) -> None:
    folder, output = field.parent / "look", field.with_name("new.safetensors")
    words = ["edit", field, "-o", output, "--to", "Wood", "--from", "ceramic", "--scale", "2", "--plots", folder]
    told, shown = results_of(capsys, *words)
    assert "gains by the law of recordings in proportion to" in shown
    new = load(output)
    expect_same(new, change_material(ceramic(), CERAMIC, WOOD, size=2.0))
    assert told["edits"][0]["to"]["name"] == "wood"
    change = 20 * torch.log10((new.gains(2 * PLACES) / ceramic().gains(PLACES))[0].abs())
    for name, values in (
        ("frequency_before", FREQUENCY),
        ("frequency_after", new.bank.frequency),
        ("t60_after", math.log(1000) / new.bank.damping),
        ("level_change_db", change),
    ):
        assert [row[name] for row in told["modes"]] == pytest.approx(values.tolist(), abs=1e-4)
    for name in ("modes.png", "spectrograms.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    before, after = (soundfile.read(folder / f"{name}.wav")[0] for name in ("before", "after"))
    # The loudest place of the old object, and the same one of the new, twice as large; both by one factor.
    levels = [float(abs(each).max()) for each in (before, after)]
    assert max(levels) == pytest.approx(10 ** (-1 / 20), rel=1e-6)
    points = ceramic().gain_field.points[::2].double()
    ratios = new.render(2 * points).abs().amax(1) / ceramic().render(points).abs().amax(1)
    assert float((ratios - levels[1] / levels[0]).abs().min()) < 1e-4 * levels[1] / levels[0]


def of_corners(values: torch.Tensor) -> SoundField:
    """Return a field with these gains [3, modes] at three corners."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64)
    alike = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(3, 3)
    gains = replace(mixture(Sites(corners, alike), values, directional=False), points=corners.float())
    return replace(ceramic(), gain_field=gains)


def test_a_modes_level_is_one_number_in_info_and_edit_whatever_its_phase(field: Path, capsys: Streams) -> None:
    save(of_corners(torch.tensor([1.0, 1.0j, -1.0, 0.6 + 0.8j, 0.1j], dtype=torch.complex128).expand(3, 5)), field)
    new, found = field.with_name("new.safetensors"), []
    changes = results_of(capsys, "edit", field, "-o", new, "--mode-db", "850", "-6")[0]["modes"]
    assert [row["level_change_db"] for row in changes] == pytest.approx([0, -6, 0, 0, 0], abs=1e-4)
    for path in (field, new):
        found.append([row["level_db"] for row in results_of(capsys, "info", path)[0]["modes"]])
    # The gains of a weaker mode are shrunk a little more by the noise.
    assert found[0] == pytest.approx([0, 0, 0, 0, -20], abs=0.1)
    assert np.subtract(*found[::-1]) == pytest.approx([0, -6, 0, 0, 0], abs=1e-4)


def test_noise_that_has_become_loud_beside_the_modes_is_noted(field: Path, capsys: Streams) -> None:
    for level in (-12, -3):
        changes = [word for hertz in FREQUENCY.tolist() for word in ("--mode-db", hertz, level)]
        _, shown = results_of(capsys, "edit", field, "-o", field.with_name("new.safetensors"), "--overwrite", *changes)
        assert ("note: the modes are 12 dB softer and the noise" in shown) == (level == -12)


def test_constants_stand_in_place_of_the_tables(field: Path) -> None:
    new = edited(field, "--from", "ceramic", *sets("material.young=1e10 material.beta=2e-7 material.law=ratio-only"))
    custom = replace(CERAMIC, young=1e10, beta=2e-7)
    expect_same(new, change_material(ceramic(), CERAMIC, custom, law="ratio-only"))
    other = edited(field, "--to", "glass", "--from", "ceramic", "--set", "material.density=5000", name="other")
    expect_same(other, change_material(ceramic(), CERAMIC, replace(GLASS, density=5000.0)))


def test_the_old_material_is_told_by_the_dampings_or_the_last_edit(field: Path) -> None:
    wood = edited(field, "--to", "wood", name="wood")
    assert wood.origin.report[EDITS][0]["from"]["name"] == "ceramic"
    edited(field.with_name("wood.safetensors"), "--pitch", "1.5", name="high")
    back = edited(field.with_name("high.safetensors"), "--to", "ceramic", name="back")
    assert back.origin.report[EDITS][2]["from"]["name"] == "wood"
    save(replace(ceramic(), bank=ModalBank(FREQUENCY, FREQUENCY)), field)
    with raises(AvmsfError, name="--from"):
        edited(field, "--to", "wood")


def test_sliders_follow_the_material_and_call_modes_by_their_old_frequencies(field: Path) -> None:
    sliders = ["--pitch", "1.2", "--decay", "0.5", "--brightness", "3", "--mode-db", "852", "-inf"]
    new = edited(field, "--to", "wood", "--from", "ceramic", *sliders, "--mode-db", "2300", "6")
    changes = {"pitch": 1.2, "decay": 0.5, "brightness_db": 3.0, "gains_db": [0.0, -math.inf, 0.0, 0.0, 6.0]}
    expect_same(new, adjust_modes(change_material(ceramic(), CERAMIC, WOOD), **changes))
    assert field_lines(new, field)[-2:] == [
        "  edited     change_material, from ceramic to wood, law displacement",
        "  edited     adjust_modes, pitch 1.2, decay 0.5, brightness_db 3, gains_db 0 to 6 by mode, 1 muted",
    ]
    words = ["--pitch", "1.2", "--mode-pitch", "850", "0.5", "--mode-pitch", "2300", "1.5", "--mode-decay", "1300", "4"]
    factors = {"pitch": [1.2, 0.6, 1.2, 1.2, 1.2 * 1.5], "decay": [1.0, 1.0, 4.0, 1.0, 1.0]}
    expect_same(edited(field, *words, name="single"), adjust_modes(ceramic(), **factors))
    for option in ("--mode-db", "--mode-pitch", "--mode-decay"):
        with raises(AvmsfError, name=option, value=1000.0) as caught:
            edited(field, option, "1000", "3")
        assert "850 Hz" in str(caught.value)


def test_towards_a_recording_and_an_interrupted_edit_goes_on(field, capsys, monkeypatch):
    target = adjust_modes(ceramic(), pitch=1.3).render(PLACES[:1])[0]
    soundfile.write(field.with_name("like.wav"), torch.cat([torch.zeros(800), target]).numpy() / 50, int(RATE))
    words = ["--like", str(field.with_name("like.wav"))]
    words += sets("guide.steps=4 guide.contacts_per_step=2 guide.preview_every=2")
    whole, part = edited(field, *words, name="whole"), field.with_name("part.safetensors")
    told = whole.origin.report[EDITS][0]
    factors = f"pitch {told['pitch']:.4g}, decay {told['decay']:.4g}"
    assert field_lines(whole, field)[-1] == f"  edited     guided, towards 'like.wav', {factors}, steps 4"
    assert float((whole.bank.frequency / FREQUENCY).median()) == pytest.approx(1.3, rel=0.1)
    steps = interrupt_at(monkeypatch, 2)
    assert main(["edit", str(field), "--output", str(part), *words]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "avmsf edit: interrupted; repeat the command to continue"
    assert not part.exists()
    preview, rate = soundfile.read(field.with_name("part.safetensors.preview.wav"))
    assert (len(preview), rate) == (2400, RATE)
    state = field.with_name("part.safetensors.checkpoint")
    kept = state.read_bytes()
    edited(field, "--pitch", "2", name="part")
    assert state.read_bytes() == kept
    del steps[:-1]
    expect_same(edited(field, *words, name="part"), whole)
    assert steps == [2, 3, 4]
    assert not list(field.parent.glob("*.preview.wav")) + list(field.parent.glob("*.checkpoint"))


def test_towards_a_materials_sound(field: Path) -> None:
    quick = [*sets("guide.steps=2 guide.contacts_per_step=2 guide.preview_every=0")]
    wood = edited(field, "--like-material", "Wood", *quick, name="wood")
    (told,) = wood.origin.report[EDITS]
    assert (told["edit"], told["reference"]) == ("guided", "wood")
    ringing = wood.bank.damping / ceramic().bank.damping
    assert float(ringing.median()) > 3.0
    # What it is of is what it was made before, and what is made of it before is what the sound is led on from.
    expected = Reference.of_material(change_material(ceramic(), GLASS, WOOD), WOOD, STEEL, seed=3).describe()
    words = ["--from", "glass", "--to", "wood", "--pitch", "1", "--like-material", "steel", "--set", "guide.seed=3"]
    both = edited(field, *words, *quick, name="both")
    assert [each["edit"] for each in both.origin.report[EDITS]] == ["change_material", "guided"]
    assert {name: both.origin.report[EDITS][1][name] for name in expected} == expected


def test_the_loudest_place_is_that_of_both_parts_of_the_gains() -> None:
    values = torch.zeros(3, 5, dtype=torch.complex128)
    values[0], values[1] = 1.0, 3.0j
    assert contact_of_sounds(of_corners(values), None).tolist() == pytest.approx([0.1, 0.0, 0.0])


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Let every model of sound answer all prompts with a ring 2 % higher; return what is asked of it, in order."""
    answer, asked = adjust_modes(ceramic(), pitch=1.02).render(PLACES[:1])[0], list[object]()
    facts = {"name": "echo", "sample_rate": RATE, "channels": 1, "device": torch.device("cpu"), "dtype": torch.float32}
    echo = SimpleNamespace(
        **facts,
        describe=lambda: {"model": "echo"},
        encode=lambda waveforms: waveforms,
        decode=lambda latents, *, samples: latents[..., :samples],
        embed=lambda prompt, *, seconds: asked.append(prompt),
        generate=lambda prompt, *, seconds, seed: 0.1 * answer[: round(seconds * RATE)],
        denoised=lambda latents, level, conditioning, *, guidance: answer.expand_as(latents),
    )
    monkeypatch.setattr(StableAudio, "load", lambda source, **settings: asked.append((source, settings)) or echo)
    return asked


def test_towards_words(field: Path, asked: list[object]) -> None:
    words = ["--prompt", "a bell", "--model", "here", *sets("guide.steps=40 guide.contacts_per_step=2")]
    words += sets("prompt.model_seconds=1 parameters=published")
    alone = field.with_name("generated.wav")
    new = edited(field, *words, "--set", f"prompt.generated={alone}")
    assert soundfile.info(str(alone)).samplerate == RATE
    (told,) = new.origin.report[EDITS]
    assert (told["parameters"], told["prompt"]) == ("published", "a bell")
    assert asked[:2] == [("here", {"seconds": 1.0, "device": None}), "a bell"]
    assert 1.005 < float((new.bank.frequency / FREQUENCY).median()) < 1.035


WRONG: dict[str, tuple[str | None, object]] = {
    "--from wood": ("--from", None),
    "--prompt bell --like like.wav": ("--prompt", ("--prompt", "--like")),
    "--like-material wood --like like.wav": ("--like", ("--like", "--like-material")),
    "--like-material cheese": ("--like-material", "cheese"),
    "--prompt ''": ("prompt", ""),
    "--to cheese": ("--to", "cheese"),
    "--like nowhere.wav": (None, None),
    "--like like.wav --set guide.steps=0": ("steps", 0),
    # What nothing would use.
    "--pitch .9 --from steel": ("--from", None),
    "--like like.wav --from wood": ("--from", None),
    "--pitch 2 --set guide.steps=9": ("guide", None),
    "--pitch 2 --set parameters=published": ("parameters", None),
    "--like like.wav --model nowhere": ("--model", None),
    "--pitch 2 --set prompt.distillation.denoising=3": ("prompt", None),
    "--like like.wav --set prompt.clap=x": ("prompt", None),
    "--pitch 2 --set material.law=ratio-only": ("material.law", None),
    "--like-material wood --set material.law=velocity": ("material.law", None),
    "--pitch 2 --position 0 0 0": ("--position", None),
    "--prompt bell --set prompt.clap=x --set guide.preview_every=0": ("prompt.clap", 0),
    # What a model cannot do.
    "--prompt bell --set prompt.distillation.guidance=-5": ("guidance", -5.0),
    "--prompt bell --set prompt.model_seconds=0": ("prompt.model_seconds", 0.0),
    "--prompt bell --set prompt.model_seconds=Infinity": ("prompt.model_seconds", math.inf),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_done_is_refused_before_a_model_is_loaded(words, field, monkeypatch):
    monkeypatch.setattr(StableAudio, "load", lambda *_, **__: pytest.fail("a model was loaded"))
    name, value = WRONG[words]
    with raises(AvmsfError, name=name, value=value):
        edited(field, *(word.strip("'") for word in words.split()))
    assert not field.with_name("new.safetensors").exists()


def test_an_edit_overwrites_no_file_and_draws_no_contact_off_the_object(field: Path) -> None:
    before = field.read_bytes()
    with raises(OutputError, file=field, name="--output"):
        run_verb("edit", str(field), "--output", str(field), "--pitch", "2", "--overwrite")
    sound = field.with_name("sound.safetensors")
    sound.write_bytes(b"RIFF")
    edited(field, "--pitch", "2")
    for there in (field.with_name("new.safetensors"), sound):
        with raises(OutputError, file=there, name="--overwrite"):
            run_verb("edit", str(field), "--output", str(there), "--pitch", "2")
    edited(field, "--pitch", "2", name="sound")
    assert field.read_bytes() == before
    with pytest.raises(OutputError):
        edited(field, "--pitch", "2", "--plots", str(field.with_name("look")), "--position", "100", "0", "0")


QUICK = ("--prompt", "a bell", "--model", "x", *sets("guide.steps=5 guide.contacts_per_step=2 guide.preview_every=2"))


@pytest.fixture
def words(field: Path, asked: list[object]) -> list[str]:
    """Return a command without its output: a field, a prompt to the model, a tiny network that scores."""
    pytest.importorskip("transformers", reason="needs pip install 'avmsf[eval]'")
    save_clap(field.with_name("clap"))
    return [str(field), *QUICK, "--set", f"prompt.clap={field.with_name('clap')}"]


def test_the_curve_is_stored_drawn_and_shown(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr("avmsf.cli.edits.save_picture", lambda figure, path: drawn.update({path.name: figure}))
    output, folder = tmp_path / "new.safetensors", tmp_path / "look"
    assert run_verb("edit", *words, "--output", str(output), "--plots", str(folder)) == 0
    new, clap = load(output), Clap.load(tmp_path / "clap")
    curve = new.origin.report[EDITS][-1]["clap"]
    assert curve["steps"] == [0, 2, 4, 5]
    # The first score is of the field as it was, the last one of the edited field, at one of its points.
    for field, score in ((ceramic(), curve["scores"][0]), (new, curve["scores"][-1])):
        points = ceramic().gain_field.points
        alone = clap.score(field.render(points), "a bell", sample_rate=RATE).numpy()
        assert np.abs(alone - score).min() < 1e-6
    (axes,) = drawn["clap.png"].axes
    assert np.asarray(axes.lines[0].get_xydata()) == pytest.approx(np.array([curve["steps"], curve["scores"]]).T)
    assert not list(tmp_path.glob("new.safetensors.*"))


def test_an_interrupted_edit_has_the_whole_curve(words, tmp_path, monkeypatch):
    def report(name: str) -> dict:
        found: dict = load(tmp_path / name).origin.report[EDITS][-1]["clap"]
        return found

    assert run_verb("edit", *words, "--output", str(tmp_path / "whole.safetensors")) == 0
    part = [*words, "--output", str(tmp_path / "part.safetensors")]
    with monkeypatch.context() as patched:
        interrupt_at(patched, 3)
        assert main(["edit", *part]) == 130
    # Other weights under the same name.
    save_clap(tmp_path / "clap", seed=1)
    with raises(AvmsfError, file="part.safetensors.checkpoint", value=["network"]):
        run_verb("edit", *part)
    save_clap(tmp_path / "clap")
    assert run_verb("edit", *part) == 0
    assert report("part.safetensors") == report("whole.safetensors")
