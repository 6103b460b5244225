"""Make the sounds of the page gallery.md: `python docs/gallery.py FOLDER`, about a minute; the docs' build runs it.

Each object is simulated, and a field fitted to eight of its recordings renders the impact of one that is held out.
"""

import sys
from pathlib import Path

import soundfile
import torch

import avmsf
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.simulation import simulate_object

OBJECTS = (("mug", "ceramic"),)
"""Kinds and materials."""
SECONDS, PEAK = 0.5, 0.5


def main(folder: Path) -> None:
    """Write KIND-MATERIAL-recorded.wav and KIND-MATERIAL-rendered.wav of each object, at one level."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, material in OBJECTS:
        recipe = ObjectRecipe(kind=kind, material=material, seed=7, impacts=10, views=0, seconds=SECONDS)
        train, test = avmsf.split(simulate_object(recipe).capture, 8)
        field = avmsf.fit(train, progress=False)
        held_out = field.aligned(test.impacts).take([0])
        rendered = field.render(held_out.contacts, held_out.directions, samples=held_out.sounds.shape[1])
        factor = PEAK / float(torch.stack([held_out.sounds, rendered]).abs().max())
        for name, sounds in (("recorded", held_out.sounds), ("rendered", rendered)):
            path, rate = folder / f"{kind}-{material}-{name}.wav", round(field.sample_rate)
            soundfile.write(path, (factor * sounds[0]).numpy(), rate, subtype="PCM_16")


main(Path(sys.argv[1]))
