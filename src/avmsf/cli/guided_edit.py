"""The optimization of a field's modes by the options of `avmsf edit`: towards a prompt, recordings, or a material."""

from avmsf._utils.text import format_number
from avmsf.cli.edit import Options
from avmsf.cli.printing import display, doing, say
from avmsf.cli.writing import Level, write_sound
from avmsf.editing.config import EditSettings
from avmsf.editing.distillation import DecoderDistillation
from avmsf.editing.guided import PARAMETERIZATIONS, Guide, GuidedEditProgress, edit_towards
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.evaluation.clap import Clap, ClapCurve
from avmsf.fem.material import Material, material_named
from avmsf.field.sound_field import SoundField

_GENERATED_SECONDS = 3.0
"""Duration of a sound that is generated from a prompt only."""


def edit_by_guide(options: Options, field: SoundField, old: Material | None) -> SoundField:
    """Return the field edited towards a prompt, recordings, or the sound of a material.

    State and preview are written next to the output, so that the same command continues to the same result. `old` is
    the field's material, needed only for `like_material`.
    """
    settings = options.all_settings
    preview, checkpoint = options.part("preview.wav"), options.part("checkpoint")
    curve: ClapCurve | None = None
    if settings.prompt.clap is not None and options.prompt is not None:
        clap, kept = Clap.load(settings.prompt.clap), options.part("clap.json")
        curve = ClapCurve(clap, options.prompt, field, kept, resumed=checkpoint.exists())
    # After CLAP: a wrong name of its network is refused before the large model is loaded.
    guide = _guide(options, settings, field, old)

    def progress(reached: GuidedEditProgress) -> None:
        if curve is not None:
            curve.add(reached)
        message = f"loss {format_number(reached.loss)}, pitch x {format_number(reached.pitch, 4)}"
        if reached.preview is not None:
            factor = Level("peak", -1.0).factor(reached.preview[None])
            write_sound(preview, factor * reached.preview, sample_rate=field.sample_rate, coding="float32")
            say(f"edit: step {reached.step} of {reached.steps}, {message}; preview in {preview}")
        display.step("edit", reached.step, reached.steps, message)

    edited = edit_towards(
        field, guide, config=settings.guide, parameters=PARAMETERIZATIONS[settings.parameters], progress=progress,
        checkpoint=checkpoint,
    )  # fmt: skip
    return edited if curve is None else curve.recorded_in(edited)


def _guide(options: Options, settings: EditSettings, field: SoundField, old: Material | None) -> Guide:
    prompted, seed = settings.prompt, settings.guide.seed
    if options.like_material is not None:
        assert old is not None
        return Reference.of_material(field, old, material_named(options.like_material), seed=seed)
    if options.prompt is None:
        return Reference.read(options.like, sample_rate=field.sample_rate)
    doing(f"loading {options.model}")
    model = StableAudio.load(options.model, seconds=prompted.model_seconds, device=prompted.device)
    if prompted.generated is not None:
        seconds = _GENERATED_SECONDS if prompted.model_seconds is None else prompted.model_seconds
        made = model.generate(options.prompt, seconds=seconds, seed=seed, negative=prompted.negative)
        write_sound(prompted.generated, made, sample_rate=model.sample_rate, coding="float32")
    return DecoderDistillation(
        model,
        options.prompt,
        sample_rate=field.sample_rate,
        negative=prompted.negative,
        config=prompted.distillation,
    )
