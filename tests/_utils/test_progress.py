"""The display of progress: what a pipe gets."""

import pytest

from avmsf._utils.progress import ProgressDisplay


@pytest.mark.parametrize(("options", "count"), [({"quiet": True}, 1), ({}, 4), ({"verbose": True}, 5)])
def test_a_stage_is_a_line_quiet_leaves_notes_and_verbose_adds_parts(options, count, capsys) -> None:
    display = ProgressDisplay(**options)
    # Names that would be markup or a control sequence.
    for _ in range(2):
        with display:
            display.listener.log("reading [bold]mug\x1b]0;title\x07")
            display.listener.step("splat", 1, 2, "loss [red]1")
            display.listener.ready("splat", 2.0)
            display.listener.ready("modes", None)
            display.objects()("mug", 1, 1)
            display.listener.note("few recordings")
        text = capsys.readouterr().err
        assert len(text.splitlines()) == count
        assert "\x07" not in text
