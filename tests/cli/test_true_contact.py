"""`avmsf locate --true-contact`: the true contact's place in the heat maps, its distance, and wrong units."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from avmsf.cli.contacts import Contacts, rows_of
from avmsf.cli.paths import OutputError
from avmsf.errors import CaptureError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.localization.locator import Locator
from avmsf.modal.residual_noise import Residual
from avmsf.modal.synthesis import synthesize
from avmsf.plotting.clouds import ALL_SIDES, view_from
from avmsf.plotting.style import FIRST, SECOND
from factories.made_fields import BANK, positional
from factories.raising import raises
from factories.verbs import run_verb

RATE, SAMPLES, STRUCK, OTHER = 8000, 4000, 68, 102


@pytest.fixture(scope="module")
def hit(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, torch.Tensor]:
    """Return a field, a recording of an impact at its point STRUCK, and its points."""
    folder = tmp_path_factory.mktemp("hit")
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    origin = Origin("plate")
    field = SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), float(RATE), SAMPLES, origin)
    save(field, folder / "plate.safetensors")
    locator = Locator.of(field)
    gains = locator.gains[STRUCK][None].to(torch.complex128)
    sound = synthesize(gains, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=float(RATE))[0]
    noise = torch.randn(len(sound) + 800, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = torch.nn.functional.pad(sound, (800, 0)) / sound.abs().max() + 1e-4 * noise
    soundfile.write(folder / "hit.wav", (0.5 * whole).numpy(), RATE, subtype="FLOAT")
    return str(folder / "plate.safetensors"), str(folder / "hit.wav"), locator.points.double()


def test_the_true_contact_is_red_at_its_place_and_the_found_one_blue(
    hit: tuple[str, str, torch.Tensor],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    field, recording, points = hit
    figures: list[Figure] = []
    monkeypatch.setattr("avmsf.plotting.pictures.save_picture", lambda figure, path: figures.append(figure))
    true = [f"{value:.9g}" for value in points[OTHER].tolist()]
    assert run_verb("locate", field, recording, "--output", str(tmp_path), "--true-contact", *true, "--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["summary"] is None
    (blow,) = results["impacts"]
    distance = float((points[STRUCK] - points[OTHER]).norm())
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    assert blow["true_contact"] == pytest.approx(points[OTHER].tolist(), abs=1e-6)
    assert blow["error"] == pytest.approx(distance, abs=1e-6)
    assert blow["in_region"] is False
    assert blow["rmed_posterior"] == pytest.approx(distance / diagonal, abs=1e-6)
    assert blow["rmed"] == pytest.approx(distance / diagonal, abs=1e-6)
    (figure,) = figures
    middle = 0.5 * (points.amax(0) + points.amin(0))
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert len(panels) == 2 * len(ALL_SIDES)
    for axes, side in zip(panels, ALL_SIDES * 2, strict=True):
        scatter = axes.collections[0]
        colors = scatter.get_facecolors()[:, :3]
        hue = colors / colors.max(axis=1, keepdims=True)
        for row, mark in ((OTHER, np.array(to_rgb(SECOND))), (STRUCK, np.array(to_rgb(FIRST)))):
            marked = np.abs(hue - mark / mark.max()).max(axis=1) < 0.01
            place = (points[row] - middle).numpy() @ view_from(side).T
            # Points are sparse here: the nearest one alone has the mark's color.
            assert np.asarray(scatter.get_offsets())[marked] == pytest.approx(place[None, :2], abs=1e-6)


def test_a_table_gives_each_recording_its_contact_and_the_summary_is_over_them(
    hit: tuple[str, str, torch.Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field, recording, points = hit
    paths = [tmp_path / name for name in ("a/hit.wav", "b/hit.wav", "other.wav")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(Path(recording).read_bytes())
    rows = ("b/hit.wav", points[OTHER]), ("a/hit.wav", points[STRUCK]), ("none.wav", points[OTHER])
    table = tmp_path / "impacts.csv"
    lines = [",".join([name, *(f"{1000 * value:.9g}" for value in place.tolist())]) for name, place in rows]
    table.write_text("\n".join(["file,x,y,z", *lines]))
    words = [field, *map(str, paths), "--true-contact-table", str(table), "--unit", "mm", "--json"]
    assert run_verb("locate", *words) == 0
    results = json.loads(capsys.readouterr().out)
    first, second, third = results["impacts"]
    distance = float((points[STRUCK] - points[OTHER]).norm())
    assert (first["error"], second["error"]) == pytest.approx((0.0, distance), abs=1e-6)
    assert (first["in_region"], second["in_region"]) == (True, False)
    assert "error" not in third
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    relative = 0.5 * distance / diagonal
    wanted = {"impacts": 2, "training": 0, "median_error": 0.5 * distance, "rmed": relative, "rmed_posterior": relative}
    assert results["summary"] == pytest.approx({**wanted, "in_region": 0.5}, abs=1e-6)


def test_a_table_may_have_absolute_paths_and_any_format(
    hit: tuple[str, str, torch.Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field, recording, points = hit
    sound = tmp_path / "hit.flac"
    soundfile.write(sound, soundfile.read(recording)[0], RATE)
    table = tmp_path / "places.csv"
    place = ",".join(f"{value:.9g}" for value in points[STRUCK].tolist())
    table.write_text(f"file,x,y,z\n{sound},{place}\n")
    assert run_verb("locate", field, str(sound), "--true-contact-table", str(table), "--json") == 0
    (impact,) = json.loads(capsys.readouterr().out)["impacts"]
    assert impact["error"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("names", "recording", "rows"),
    [
        (("hit.wav",), "a/hit.wav", [0]),
        (("b/hit.wav",), "a/hit.wav", [0]),
        (("hit.wav", "a/hit.wav"), "a/hit.wav", [1]),
        (("hit.wav", "a/hit.wav"), "b/hit.wav", [0]),
        (("a/hit.wav", "x/a/hit.wav", "y/a/hit.wav"), "/x/a/hit.wav", [1]),
        (("/x/hit.wav", "/y/hit.wav"), "/y/hit.wav", [1]),
        (("a/hit.wav", "b/hit.wav"), "c/hit.wav", [0, 1]),
        (("other.wav", "a/hit.flac"), "a/hit.wav", []),
    ],
)
def test_a_recording_has_the_row_with_most_of_its_path(names: tuple[str, ...], recording: str, rows: list[int]) -> None:
    contacts = Contacts(torch.zeros(len(names), 3, dtype=torch.float64), names)
    assert rows_of(contacts, Path(recording)) == rows


def test_a_table_that_names_no_recordings_or_has_another_unit_is_refused(
    hit: tuple[str, str, torch.Tensor], tmp_path: Path
) -> None:
    field, recording, _ = hit
    table = tmp_path / "places.csv"
    table.write_text("x,y,z\n0,0,0\n")
    with raises(CaptureError, file=table, name="file"):
        run_verb("locate", field, recording, "--true-contact-table", str(table))
    table.write_text("tap,x_mm\n1,2\n")
    with raises(CaptureError, file=table, name="file", value=["tap", "x_mm"]) as caught:
        run_verb("locate", field, recording, "--true-contact-table", str(table))
    assert "tap, x_mm" in str(caught.value)
    table.write_text("x,y,z,file\n0,0,0\n")
    with raises(CaptureError, file=table, row=2, name="file"):
        run_verb("locate", field, recording, "--true-contact-table", str(table))
    table.write_text("file,x,y,z\nhit.wav,120,40,0\n")
    with raises(OutputError, file=table, row=2):
        run_verb("locate", field, recording, "--true-contact-table", str(table))
    with raises(OutputError, name="--true-contact"):
        run_verb("locate", field, recording, "--true-contact-table", str(table), "--true-contact", "0", "0", "0")


@pytest.mark.parametrize("wrong", [("120", "40", "0"), (str(math.nan), "0", "0")])
def test_a_contact_in_another_unit_is_refused(hit: tuple[str, str, torch.Tensor], wrong: tuple[str, ...]) -> None:
    field, recording, _ = hit
    with raises(OutputError, name="--true-contact", row=0):
        run_verb("locate", field, recording, "--true-contact", *wrong)
