"""The typed configuration of every stage, read from params.yaml and conf/ and checked before anything runs."""

import dataclasses
import functools
import logging
import os
import sys
import typing
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Annotated, Any, TypeVar

import hydra
from omegaconf import DictConfig, OmegaConf

from polarnet.benchmark.rows import ROWS
from polarnet.benchmark.score import BenchmarkConfig
from polarnet.captures.dot import RecordingsConfig
from polarnet.config.experiments import check_overrides
from polarnet.config.origins import Run
from polarnet.methods import METHODS
from polarnet.methods.method import GainConfig
from polarnet.methods.registration import RegistrationConfig
from polarnet.metrics.lpips import BACKBONES, LpipsConfig, installed_version
from polarnet.networks.registry import NETWORKS, NetworkConfig
from polarnet.pictures.ingest import IngestConfig
from polarnet.runtime.cluster import pmap
from polarnet.runtime.machine import RuntimeConfig, configure, threads_of
from polarnet.runtime.sections import one_of, section, section_of
from polarnet.simulation.camera import Camera, PolarizersConfig, ReadoutConfig, grid
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.simulation.rotating import RotatingConfig
from polarnet.simulation.sets import Recipe, SetsConfig
from polarnet.simulation.variation import VariationConfig
from polarnet.storage.parts import StorageConfig
from polarnet.training.baselines import BASELINES
from polarnet.training.engine.loop import LoopConfig, TrainConfig
from polarnet.training.engine.losses import LossConfig

ROOT_VARIABLE = "POLARNET_ROOT"  # read by hydra.searchpath in conf/config.yaml
BEST = "best.safetensors"
DOLP_TRAINING = "ours"
"""Training of the DoLP network, in data/train beside the baselines."""

Stage = Callable[["Config"], None]
T = TypeVar("T")
RowName = Annotated[str, one_of(ROWS)]
BaselineName = Annotated[str, one_of(BASELINES)]
OWN_KEYS = ("epochs", "crop", "visits", "windows", "bptt_windows", "precision")
"""Keys of a training that each baseline has in its own section; the others stand in `baselines.training`."""


if typing.TYPE_CHECKING:
    NetworksConfig = Any
    MethodsConfig = Any
    BaselinesConfig = Any
else:
    NetworksConfig = section_of("NetworksConfig", NETWORKS)
    """Section `networks` of params.yaml: one section for each network; `network` names the network in use."""
    MethodsConfig = section_of(
        "MethodsConfig",
        {m.name: m.config for m in METHODS.values() if m.config is not None}
        | {"gain": GainConfig, "registration": RegistrationConfig},
    )
    """Section `methods` of params.yaml: one section for each method with settings, and two that methods share."""
    _OF_LOOP = typing.get_type_hints(LoopConfig, include_extras=True)
    SharedTrainingConfig = section_of(
        "SharedTrainingConfig", {name: hint for name, hint in _OF_LOOP.items() if name not in OWN_KEYS}
    )

    def _own_section(config: type) -> type:
        hints = typing.get_type_hints(config, include_extras=True)
        return section_of(
            config.__name__, {name: hint for name, hint in hints.items() if name in OWN_KEYS or name not in _OF_LOOP}
        )

    BaselinesConfig = section_of(
        "BaselinesConfig",
        {"trained": list[BaselineName], "training": SharedTrainingConfig}
        | {name: _own_section(record.config) for name, record in BASELINES.items()},
    )
    """Section `baselines` of params.yaml: those to train, the settings that they share, and one section for each."""


@section
class RowConfig:
    """Entry of section `rows` of params.yaml, from which dvc.yaml makes the stage of a row."""

    needs: str
    """Path of a further input: the weights of the row's network (a file, or the folder of a training), other events,
    or a file that every row has."""
    settings: str
    """Section of params.yaml that the row depends on."""


@section
class ClusterConfig:
    """Section `cluster` of conf/config.yaml."""

    address: str | None
    """Address of a Dask scheduler (tcp://host:port); null runs processes on this machine."""


@section
class Paths:
    """Section `paths` of conf/config.yaml: the location of each artefact. dvc.yaml names the same locations."""

    data: str
    images: str
    scenes: str
    frames: str
    events: str
    train: str
    sets: str
    rotating: str
    benchmark: str
    report: str
    calibrated: str
    resume: str


@section
class Config:
    """All settings of a stage: those of params.yaml, then the paths and runtime settings of conf/config.yaml."""

    seed: int
    ingest: IngestConfig
    synthesize: SynthesizeConfig
    variation: VariationConfig
    emulate: EmulatorConfig
    polarizers: PolarizersConfig
    readout: ReadoutConfig
    storage: StorageConfig
    network: Annotated[str, one_of(NETWORKS)]
    networks: NetworksConfig
    loss: LossConfig
    train: TrainConfig
    lpips: LpipsConfig
    methods: MethodsConfig
    baselines: BaselinesConfig
    benchmark: BenchmarkConfig
    rows: dict[RowName, RowConfig]
    """Rows of the tables."""
    sets: SetsConfig
    recordings: RecordingsConfig
    rotating: RotatingConfig
    row: RowName | None
    """Row that stage row runs."""
    baseline: BaselineName | None
    """Baseline that stage train trains; None: the DoLP network."""
    paths: Paths
    runtime: RuntimeConfig
    cluster: ClusterConfig

    def __post_init__(self):
        self._check_rows()
        self._check_files()
        self._check_baseline()
        self._check_sizes()

    def _check_sizes(self) -> None:
        """ValueError for a DoFP sensor of odd size, a crop larger than a channel, and images too small for LPIPS."""
        size = self.synthesize.sensor_height, self.synthesize.sensor_width
        channel = list(grid(self.polarizers.layout, *size)[:2])
        crops = {f"baselines.{name}": self.baseline_config(name).crop for name in self.baselines.trained}
        for training, crop in {"train": self.train.crop, **crops}.items():
            if crop is not None and (crop[0] > channel[0] or crop[1] > channel[1]):
                raise ValueError(
                    f"{training}.crop: expected at most a channel of section synthesize's sensor, {channel}, got {crop}"
                )
        crops |= {"loss": self.train.crop, "benchmark": None}
        for key, backbone in self.lpips_backbones.items():
            image, side = crops[key.rpartition(".")[0]] or channel, BACKBONES[backbone].min_side
            if min(image) < side:
                raise ValueError(f"{key}: LPIPS ({backbone}) needs images of {side} pixels a side, got {image}")

    def _check_rows(self) -> None:
        """ValueError for a row that reads another section than its entry names, or whose training no stage makes."""
        for row, entry in self.rows.items():
            read = METHODS[row].settings if row in METHODS else None
            if read is not None and entry.settings not in (read, "methods"):
                raise ValueError(f"rows.{row}.settings: expected {read}, which the row reads, got {entry.settings}")
            needs = PurePath(entry.needs)
            if needs.parent == PurePath("data/train") and needs.name not in (DOLP_TRAINING, *self.baselines.trained):
                raise ValueError(f"rows.{row}.needs: no stage makes {needs}; add {needs.name} to baselines.trained")

    def _check_files(self) -> None:
        """ValueError for a file outside the folder of data/external that the stage which reads it depends on."""
        file, watched = self.train.start, Path("data", "external", "start")  # of the project, as in dvc.yaml
        if file is not None and not Path(file).absolute().is_relative_to(watched.absolute()):
            raise ValueError(
                f"train.start: expected a file below {watched}, whose content `dvc repro` follows, got {file}; copy "
                "the .safetensors and the .json there"
            )

    def _check_baseline(self) -> None:
        """ValueError for a baseline to train whose weights no row uses."""
        name = self.baseline
        if name is not None and name not in self.used_baselines:
            raise ValueError(
                f"baseline: no row of benchmark.methods uses the weights of baselines.{name}, so it is not trained; "
                f"add a row with needs: data/train/{name}, or remove {name} from baselines.trained"
            )

    @property
    def used_baselines(self) -> list[str]:
        """Baselines whose training a row of `benchmark.methods` needs."""
        needed = {self.rows[row].needs for row in self.benchmark.methods if row in self.rows}
        return [name for name in BASELINES if f"data/train/{name}" in needed]

    def baseline_config(self, name: str) -> LoopConfig:
        """All settings of a baseline's training: its own, and those that all baselines share."""
        settings = dataclasses.asdict(self.baselines.training) | dataclasses.asdict(getattr(self.baselines, name))
        return BASELINES[name].config(**settings)

    def place(self, artefact: str) -> Path:
        """Location of an artefact, for which dvc.yaml and section `rows` say data/NAME."""
        folder, *parts = PurePath(artefact).parts
        if folder != "data" or not parts or not hasattr(self.paths, name := parts[0].removesuffix(".zarr")):
            return Path(artefact)
        return Path(getattr(self.paths, name), *parts[1:])

    def weights_of(self, row: str) -> Path | None:
        """File of the weights that a row of the tables needs; None if `rows` has no such row."""
        if row not in self.rows:
            return None
        path, trained = self.place(self.rows[row].needs), self.rows[row].needs.startswith("data/train/")
        return path / BEST if trained or path.is_dir() else path

    @property
    def lpips_backbones(self) -> dict[str, str]:
        """Backbone of LPIPS by the key that asks for it: weights in the losses of all trainings, and the tables."""
        weights = {"loss.lpips": self.loss.lpips} | {
            f"baselines.{name}.{key}": getattr(getattr(self.baselines, name), key)
            for name in self.baselines.trained
            for key in BASELINES[name].lpips
        }
        backbones = {key: self.lpips.backbone for key, weight in weights.items() if weight > 0}
        return backbones | ({"benchmark.lpips": self.benchmark.lpips_backbone} if self.benchmark.lpips else {})

    @property
    def network_config(self) -> NetworkConfig:
        """Settings of the network in use."""
        return getattr(self.networks, self.network)

    @property
    def camera(self) -> Camera:
        """The simulated camera."""
        return Camera(self.emulate, self.polarizers, self.readout)

    @property
    def recipe(self) -> Recipe:
        """Settings that make sequences from pictures."""
        threads, size = threads_of(self.runtime), self.storage.sequences_per_part
        return Recipe(self.ingest, self.synthesize, self.camera, self.seed, threads, size)

    def mapper(self, label: str) -> functools.partial[list[Any]]:
        """Parallel map with the workers and the cluster of this configuration; `label` names its progress bar."""
        return functools.partial(pmap, workers=self.runtime.workers, label=label, address=self.cluster.address)


def typed(node: DictConfig) -> Config:
    """Build the frozen, checked configuration; ValueError names every unknown key and invalid value by its full key."""
    values: Any = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    return Config(**values)


def load(root: Path, overrides: list[str] | None = None, presets: Path | None = None) -> Config:
    """Load the configuration of the project at `root`; overrides may also choose presets from conf/ of `presets`.

    ValueError for an unknown key or an invalid value.
    """
    overrides = overrides or []
    check_overrides(Config, root, overrides, presets)
    os.environ[ROOT_VARIABLE] = str(root)
    if presets and presets != root and (presets / "conf").is_dir():
        overrides = [*overrides, f"hydra.searchpath=['file://{root}','file://{presets / 'conf'}']"]
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(root / "conf")):
        return typed(hydra.compose("config", overrides=overrides))


def hydra_stage(main: Stage) -> Callable[[], None]:
    """Make `main(config)` a Hydra command line that checks the configuration and sets up the runtime first.

    It also refuses LPIPS without its weights, and inputs made with other values (`polarnet.config.origins`).
    """
    root, script = _root_of(main), _file_of(main).stem

    @functools.wraps(main)
    def checked(node: DictConfig) -> None:
        config = or_exit(lambda: typed(node))
        or_exit(lambda: check_lpips(config))
        run = Run(root, config, script)
        or_exit(run.check_inputs)
        configure(config.runtime, config.seed)
        or_refuse(lambda: main(config), f"stage {script}")
        run.write_origins()

    return hydra_command(checked)


def hydra_command(main: Callable[[DictConfig], None]) -> Callable[[], None]:
    """Make `main(node)` a Hydra command line that refuses unknown keys and choices; values in `node` are not checked.

    Hydra's log also receives the warnings of Python and its packages.
    """
    root = _root_of(main)
    run = hydra.main(version_base="1.3", config_path=str(root / "conf"), config_name="config")(main)

    def command_line() -> None:
        os.environ[ROOT_VARIABLE] = str(root)
        overrides = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
        or_exit(lambda: check_overrides(Config, root, overrides))
        logging.captureWarnings(True)
        run()

    return command_line


def input_folder(key: str, folder: str) -> Path:
    """Folder that setting `key` names; SystemExit with a one-line message if it holds no user files."""
    files = (path for path in Path(folder).rglob("*") if (path.is_file() or path.is_symlink()) and path.name[0] != ".")
    if any(path.name != "README.md" and path.suffix != ".dvc" for path in files):
        return Path(folder)
    raise SystemExit(
        f"{key}={folder}: no files there; put your files there, or set {key} to another folder (for a queued "
        f"experiment, to its absolute path)"
    )


def _root_of(main: Callable[..., None]) -> Path:
    """Root of the project whose folder `stages` contains the module of `main`."""
    return _file_of(main).parent.parent


def _file_of(main: Callable[..., None]) -> Path:
    return Path(sys.modules[main.__module__].__file__ or "").resolve()


def check_lpips(config: Config) -> None:
    """ValueError, with the keys that request LPIPS and the overrides that turn it off, if its weights are missing."""
    for backbone in dict.fromkeys(config.lpips_backbones.values()):
        keys = [key for key, asked in config.lpips_backbones.items() if asked == backbone]
        try:
            installed_version(backbone)
        except ValueError as error:
            without = " ".join(f"{key}={'false' if key == 'benchmark.lpips' else 0}" for key in keys)
            raise ValueError(f"{', '.join(keys)}: {error}; to go without: {without}") from None


def or_exit(check: Callable[[], T]) -> T:
    """Return the result of `check`; a ValueError ends the program with its message."""
    try:
        return check()
    except ValueError as error:
        raise SystemExit(f"configuration error: {error}") from None


def or_refuse(work: Callable[[], T], name: str) -> T:
    """Return the result of `work`; a refusal or a lack of room ends the program with one line, without a traceback.

    Hydra's variable HYDRA_FULL_ERROR=1 brings the traceback back.
    """
    try:
        return work()
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        raise SystemExit(f"{name}: {error or type(error).__name__}") from None
