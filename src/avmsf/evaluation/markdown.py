"""A report as Markdown."""

from collections.abc import Sequence

from avmsf.evaluation.report_tables import Grid, Section


def markdown(parts: Sequence[Section]) -> str:
    """Return the parts as one text: the first one's title above all, each table in pipes."""
    lines: list[str] = []
    for place, part in enumerate(parts):
        lines += [f"{'#' if place == 0 else '##'} {_escaped(part.title)}", ""]
        for words in part.words:
            lines += [_escaped(words), ""]
        if part.grid is not None:
            lines += [*_table(part.grid), ""]
        for words in part.remarks:
            lines += [_escaped(words), ""]
    return "\n".join(lines).rstrip() + "\n"


def _table(grid: Grid) -> list[str]:
    figures = len(grid.columns) - 1
    lines = [_row(grid.columns), f"|---|{'---:|' * figures}"]
    for number, row in enumerate(grid.rows):
        words = map(_escaped, row)
        cells = [f"**{cell}**" if (number, place) in grid.best else cell for place, cell in enumerate(words)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(_escaped(cell) for cell in cells)} |"


def _escaped(words: str) -> str:
    return words.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
