"""`avmsf dataset check`: which parts of a dataset are present, and which are missing."""

from dataclasses import asdict

from avmsf._utils.wording import counted
from avmsf.cli.options.dataset import Options
from avmsf.cli.printing import console, next_command, print_json, say, table
from avmsf.datasets import DatasetReport, ObjectReport, open_dataset

UNREADABLE = 2


def run(options: Options) -> int:
    """Print the report; return 2 where no object can be read."""
    report = open_dataset(options.dataset, contacts=options.contact_data).check()
    screen = console(errors=options.json)
    screen.print(_table(report, f"{report.dataset} in {options.dataset}"))
    for line in _lines(report):
        screen.print(line, soft_wrap=True)
    if options.json:
        print_json(asdict(report))
    readable = sum(_readable(each) for each in report.objects)
    if not readable:
        say(f"avmsf dataset: {options.dataset}: expected a readable object, found none; fix the listed problems")
        return UNREADABLE
    recordings = sum(each.recordings for each in report.objects)
    screen.print(
        f"{readable} of {counted(len(report.objects), 'object')} can be read, with {counted(recordings, 'recording')}",
        soft_wrap=True,
    )
    next_command("avmsf evaluate farthest", options.dataset)
    return 0


def _readable(report: ObjectReport) -> bool:
    return report.recordings >= 2


def _lines(report: DatasetReport) -> list[str]:
    """Return what is not in the table, a line each: missing parts, then problems, then remarks."""
    problems = [f"{each.facts.identifier}: {problem}" for each in report.objects for problem in each.problems]
    return [*(f"missing: {part}" for part in report.missing), *problems, *(f"note: {each}" for each in report.remarks)]


def _table(report: DatasetReport, title: str) -> object:
    rows = []
    for each in report.objects:
        facts = each.facts
        inferred = " (inferred)" * facts.inferred
        rows.append(
            (
                facts.identifier,
                "unreadable" if not _readable(each) else "incomplete" if each.problems else "good",
                "–" if facts.name == facts.identifier else facts.name + inferred,
                "–" if facts.material is None else facts.material + inferred,
                str(each.recordings),
            )
        )
    return table(title, ("object", "state", "name", "material", "recordings"), rows, words=4)
