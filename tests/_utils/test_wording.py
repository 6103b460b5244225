"""Numbers in words for people."""

from avmsf._utils.wording import counted


def test_one_is_no_plural() -> None:
    assert [counted(number, "wav file") for number in (0, 1, 2)] == ["0 wav files", "1 wav file", "2 wav files"]
