"""One locator, used by several threads at once, as the studio does."""

from concurrent.futures import ThreadPoolExecutor

import torch

from avmsf.localization.locator import Locator
from opened_plate import plate_field


def test_threads_that_prepare_and_locate_at_once_get_what_one_alone_gets() -> None:
    field = plate_field("elastic")
    sounds = [field.render(field.gain_field.points[[row]])[0] for row in (3, 40, 90, 130)]
    alone = [Locator.of(field).locate(sound).probability for sound in sounds]
    locator = Locator.of(field)

    def locate(number: int) -> torch.Tensor:
        locator.prepare(400 + 80 * (number % 4))
        return locator.locate(sounds[number % 4]).probability

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(locate, range(8)))
    for number, probability in enumerate(found):
        assert torch.equal(probability, alone[number % 4])
