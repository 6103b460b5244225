"""Options of `avmsf evaluate`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.checks import expect_device, expect_modes
from avmsf.cli.options.common import Configured, Flag
from avmsf.cli.options.paths import CacheFolder, Existing, OutputFolder
from avmsf.cli.options.settings import with_settings
from avmsf.datasets.detect import detect_dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import PROTOCOLS, expect_suited, method_entry, protocol_named
from avmsf.gaussians.config import SplatConfig
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import BodyConfig, Geometry, LiftConfig, TimeZero


@dataclass(frozen=True)
class EvaluationSettings:
    """What methods share."""

    geometry: Geometry = "mesh"
    """Shape that finite elements use. mesh: the object's mesh. gaussians: the surface of Gaussians fitted to its views.
    noisy: its mesh with vertices displaced by 2 % of its size."""
    amplitude_scale: Literal["full-scale", "raw"] = "full-scale"
    """full-scale: an object's sounds times one factor that brings its loudest recording to a peak of one, so that
    values of different objects can be averaged. raw: in the recordings' unit."""
    extraction: ExtractionMethod = "high-resolution"
    """How the modes that methods share are extracted; see `avmsf modes --help`. The methods `paper` have their own."""
    modes: int = 128
    """Maximum number of the modes that methods share."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made. The methods `paper` use the paper's own settings and only the encoder given here: DINOv2
    without `lift.encoder`, which then has to be installed."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Elastic bodies."""

    def __post_init__(self) -> None:
        expect_modes(self.modes)


@dataclass(frozen=True)
class Options(Configured):
    """Evaluate methods at held-out contacts, on all objects of a dataset.

    Every value is kept as it is computed: repeat an interrupted command to continue it, and add methods or objects
    later. The folder of results holds summary.json, report.md and report.html, which shows and plays sounds.
    """

    protocol: tyro.conf.Positional[
        Annotated[str, tyro.conf.arg(metavar="PROTOCOL", help=f"The experiment: {', '.join(PROTOCOLS)}.")]
    ]
    data: tyro.conf.Positional[
        Annotated[
            Path, tyro.conf.arg(metavar="DATA"), Existing("a dataset, capture folders or one capture", ("a folder",))
        ]
    ]
    """Folder of a dataset, of capture folders, or of one capture."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Methods, separated by commas or blanks; by default those of the protocol."""
    objects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Objects, separated by commas or blanks; by default those of the protocol."""
    output: OutputFolder = None
    """Folder of results; by default evaluation/DATASET/PROTOCOL in the current folder."""
    cache: CacheFolder = None
    """Keep the objects' features here, which several evaluations of one dataset may share; by default in the folder of
    results."""
    test: Annotated[tuple[str, ...], tyro.conf.arg(metavar="RECORDING ...")] = ()
    """predefined: names of the recordings to test on, such as 009.wav, separated by commas or blanks."""
    counts: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (16, 8, 4, 2, 1)
    """shots: numbers of training contacts."""
    starts: int = 1
    """shots: number of first contacts, evenly spaced in the table, that the choices start from."""
    visual_source: Literal["best", "mesh"] = "best"
    """Source of the visual features. best: photographs if there are any, by Gaussians, otherwise the mesh. mesh: the
    mesh, onto its own surface."""
    workers: int = 1
    """Number of objects computed at a time, each on one thread; more than one needs the extra `scale`."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address of a ray cluster to compute on, or auto; its computers have to see data and results at the same paths."""
    seed: int = 0
    """Seed of all methods."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device for Gaussians (with gsplat), DINOv2 and training; by default the GPU if there is one."""
    no_cdpam: Flag = False
    """Do not compute the metric CDPAM, which needs the extra `eval`."""
    cdpam_contacts: int = 8
    """Number of test contacts per case at which CDPAM is computed, evenly spaced; 0 for all."""
    time_zero: TimeZero | None = None
    """Start of the sounds on which all methods are scored: onset, or peak (paper); by default that of the dataset or of
    each capture.toml. With peak, the methods `field...` are fitted to the recordings from the dataset's own starts,
    and no method is compared with the ground truth of simulated objects."""
    contact_data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER"), Existing("ObjectFolder Real's contacts", ("a folder",))
    ] = None
    """ObjectFolder Real's contacts: SonicGauss's lists in a folder, or one of them."""
    figures: Flag = False
    """Also draw figures/OBJECT.png in the folder of results: spectrograms of the recording and of all methods, 20 Hz to
    20 kHz, first second; with localize also each field's heat maps of three recordings, with the true contact
    marked."""

    usual = EvaluationSettings()

    @cached_property
    def all_settings(self) -> EvaluationSettings:
        """What methods share."""
        return with_settings(self.usual, self.set, self.config)

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        protocol_named(self.protocol)
        for name in words_of(self.methods):
            method_entry(name)
            expect_suited(name, self.protocol)
        if self.protocol == "predefined" and not self.test:
            raise EvaluationError.expected(
                "names of the recordings to test on", name="--test", advice="such as --test 009.wav,010.wav"
            )
        expect_device(self.device, raising=EvaluationError)
        _ = self.all_settings
        detect_dataset(self.data)


def words_of(given: Sequence[str]) -> tuple[str, ...]:
    """Return words that commas or blanks separate."""
    return tuple(word for each in given for word in each.split(",") if word)
