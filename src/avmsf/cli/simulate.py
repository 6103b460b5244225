"""`avmsf simulate`: objects whose modes and gains are known, struck, recorded and photographed."""

from pathlib import Path

from avmsf.cli import INTERRUPTED
from avmsf.cli.options.simulate import Options
from avmsf.cli.printing import console, next_command, print_json, print_result, say, table
from avmsf.cli.progress import ProgressBar
from avmsf.fem.material import MATERIALS
from avmsf.simulate.recipe import NON_SYMMETRIC, SETS, ObjectRecipe
from avmsf.simulate.shapes import KINDS
from avmsf.simulate.simulation_folder import simulate_set


def run(options: Options) -> int:
    """Simulate; return 130 where Ctrl-C stopped it."""
    if options.list:
        _list(errors=options.json)
        if options.json:
            names = [name for objects in SETS.values() for name in objects]
            print_json({"objects": names, "shapes": list(KINDS), "materials": list(MATERIALS)})
        return 0
    assert options.output is not None
    recipes, folder = _chosen(options, options.output)
    try:
        with ProgressBar() as bar:
            simulate_set(recipes, folder, cache=options.cache, progress=bar.objects)
    except KeyboardInterrupt:
        say("avmsf simulate: interrupted; repeat the command to continue")
        return INTERRUPTED
    text = f"wrote {options.output}" if len(recipes) == 1 else f"wrote {len(recipes)} objects to {options.output}"
    values = {"output": str(options.output), "objects": [str(folder / name) for name in recipes]}
    print_result(text, values, json=options.json)
    next_command("avmsf check", folder / next(iter(recipes)))
    return 0


def _chosen(options: Options, output: Path) -> tuple[dict[str, ObjectRecipe], Path]:
    """Return the recipes by their folders' names, and the folder that holds these."""
    if options.what in SETS:
        return {name: options.applied(recipe) for name, recipe in SETS[options.what].items()}, output
    place = output.resolve()
    return {place.name: options.all_settings}, place.parent


def _list(*, errors: bool) -> None:
    screen = console(errors=errors)
    rows = [
        (title, name, recipe.kind, recipe.material, str(recipe.seed), "no" if name in NON_SYMMETRIC else "yes")
        for title, objects in SETS.items()
        for name, recipe in objects.items()
    ]
    columns = ("set", "object", "shape", "material", "seed", "rotational symmetry")
    screen.print(table("objects", columns, rows, words=4))
    screen.print(f"shapes for --kind: {', '.join(KINDS)}")
    screen.print(f"materials: {', '.join(MATERIALS)}")
