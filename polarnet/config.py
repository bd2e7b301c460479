"""The typed schema of params.yaml and conf/: what a stage gets, checked before anything runs."""

import dataclasses
import functools
import os
import sys
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from polarnet.evaluation.score import BenchmarkConfig
from polarnet.lpips import LpipsConfig, lpips_problem
from polarnet.methods import METHODS
from polarnet.methods.postprocessing import PostprocessingConfig
from polarnet.methods.stokes_gain import GainConfig
from polarnet.networks.dolp_unet import DolpUNetConfig
from polarnet.networks.registry import NetworkConfig
from polarnet.networks.stokes_unet import StokesUNetConfig
from polarnet.ranges import check_ranges
from polarnet.recordings.dot import RecordingsConfig
from polarnet.runtime import RuntimeConfig, configure
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import MotionConfig
from polarnet.simulation.pictures.ingest import IngestConfig
from polarnet.simulation.sets import SetsConfig
from polarnet.simulation.variation import VariationConfig
from polarnet.training.e2p import E2pConfig
from polarnet.training.e2v import E2vConfig
from polarnet.training.loop import TrainConfig
from polarnet.training.losses import LossConfig

ROOT_VARIABLE = "POLARNET_ROOT"  # read by hydra.searchpath in conf/config.yaml

Stage = Callable[["Config"], None]
T = TypeVar("T")


@dataclass(frozen=True)
class NetworksConfig:
    """Section `networks` of params.yaml: one entry a network; `network` names the one in use."""

    paper: DolpUNetConfig
    polarnet: StokesUNetConfig


if typing.TYPE_CHECKING:
    MethodsConfig = Any
else:
    MethodsConfig = dataclasses.make_dataclass(
        "MethodsConfig", [(m.name, m.config) for m in METHODS.values() if m.config is not None], frozen=True
    )
    """Section `methods` of params.yaml: the sections that the records declare."""


@dataclass(frozen=True)
class BaselinesConfig:
    """Section `baselines` of params.yaml."""

    postprocessing: PostprocessingConfig
    gain: GainConfig
    e2v: E2vConfig
    e2p: E2pConfig


@dataclass(frozen=True)
class ClusterConfig:
    """Section `cluster` of conf/config.yaml."""

    address: str | None
    """Of a Dask scheduler (tcp://host:port); null: processes on this machine."""


@dataclass(frozen=True)
class Paths:
    """Section `paths` of conf/config.yaml: where each artefact lies. dvc.yaml names the same places."""

    data: str
    images: str
    scenes: str
    frames: str
    events: str
    weights: str
    train: str
    train_e2v: str
    train_e2p: str
    sets: str
    benchmark: str
    report: str
    imported: str
    calibrated: str
    resume: str
    cache: str


@dataclass(frozen=True)
class Config:
    """Everything a stage may ask: params.yaml, then the plumbing of conf/config.yaml."""

    seed: int
    ingest: IngestConfig
    synthesize: MotionConfig
    variation: VariationConfig
    emulate: EmulatorConfig
    network: str
    networks: NetworksConfig
    loss: LossConfig
    train: TrainConfig
    lpips: LpipsConfig
    methods: MethodsConfig
    baselines: BaselinesConfig
    benchmark: BenchmarkConfig
    sets: SetsConfig
    recordings: RecordingsConfig
    paths: Paths
    runtime: RuntimeConfig
    cluster: ClusterConfig

    def __post_init__(self):
        check_ranges(self)
        known = [field.name for field in dataclasses.fields(NetworksConfig)]
        if self.network not in known:
            raise ValueError(f"network: expected one of {', '.join(known)}, got {self.network!r}")
        window = [self.synthesize.window_height, self.synthesize.window_width]
        crops = {
            "train.crop": self.train.crop,
            "baselines.e2v.crop": self.baselines.e2v.crop,
            "baselines.e2p.crop": self.baselines.e2p.crop,
        }
        for key, crop in crops.items():
            if crop is not None and (crop[0] > window[0] or crop[1] > window[1]):
                raise ValueError(f"{key}: expected at most the window of section synthesize, {window}, got {crop}")

    @property
    def network_config(self) -> NetworkConfig:
        """The section of `networks` that `network` names."""
        return getattr(self.networks, self.network)


def typed(node: DictConfig) -> Config:
    """The frozen, range-checked configuration; ValueError that names the full key of the first bad value."""
    values = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    return _built(Config, values, "")


def load(root: Path, overrides: list[str] | None = None) -> Config:
    """The configuration that the project at `root` would run with, outside any Hydra application."""
    os.environ[ROOT_VARIABLE] = str(root)
    register_schema()
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(root / "conf")):
        return typed(hydra.compose("config", overrides=overrides or []))


def register_schema() -> None:
    """Give Hydra the schema under the name that conf/config.yaml's defaults list starts with."""
    ConfigStore.instance().store(name="schema", node=_schema_of(Config))


def check_keys(root: Path, overrides: list[str]) -> None:
    """Raise a ValueError for the first key of params.yaml or of `overrides` that is not a setting, listing those there.

    Hydra refuses such a key as well, but does not say which ones there are.
    """
    params = OmegaConf.to_container(OmegaConf.load(root / "params.yaml"))
    for key in _leaves(params):
        _check_key(key, "params.yaml")
    groups = {path.name for path in (root / "conf").iterdir() if path.is_dir()}
    for override in overrides:
        key = override.split("=", 1)[0].lstrip("+~").split("@")[0]
        if key not in groups and not key.startswith(("hydra.", "hydra/", "paths.data")):
            _check_key(key, "command line")


def hydra_stage(main: Stage) -> Callable[[], None]:
    """Make `main(config)` a Hydra command line: composes, checks, sets up the runtime, then runs it.

    Refuses, before anything runs, a key that does not exist, a wrong type, a value out of range, and an experiment
    that requires LPIPS weights nobody has put in place.
    """
    root = Path(sys.modules[main.__module__].__file__ or "").resolve().parent.parent
    os.environ[ROOT_VARIABLE] = str(root)
    register_schema()

    def command_line() -> None:
        overrides = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
        _or_exit(lambda: check_keys(root, overrides))
        run()

    @functools.wraps(main)
    def checked(node: DictConfig) -> Any:
        config = _or_exit(lambda: typed(node))
        _or_exit(lambda: _check_lpips(config))
        configure(config.runtime, config.seed)
        return main(config)

    run = hydra.main(version_base="1.3", config_path=str(root / "conf"), config_name="config")(checked)
    return command_line


def _check_lpips(config: Config) -> None:
    if config.lpips.required and (problem := lpips_problem(config.lpips, config.paths.weights)):
        raise ValueError(f"lpips.required is true: {problem}")


def _check_key(key: str, where: str) -> None:
    section: Any = Config
    path = key.split(".")
    for depth, name in enumerate(path):
        names = sorted(field.name for field in dataclasses.fields(section)) if dataclasses.is_dataclass(section) else []
        if name not in names:
            inside = ".".join(path[:depth]) or "the configuration"
            allowed = f"{inside} has {', '.join(names)}" if names else f"{inside} is a value, not a section"
            raise ValueError(f"{where}: {key} is not a setting; {allowed}")
        section = typing.get_type_hints(section)[name]


def _leaves(values: Any, prefix: str = "") -> list[str]:
    if not isinstance(values, dict):
        return [prefix]
    return [leaf for key, value in values.items() for leaf in _leaves(value, f"{prefix}.{key}" if prefix else str(key))]


def _or_exit(check: Callable[[], T]) -> T:
    try:
        return check()
    except ValueError as error:
        raise SystemExit(f"configuration error: {error}") from None


@functools.cache
def _schema_of(config_class: type) -> type:
    """`config_class` without `frozen`: OmegaConf makes frozen dataclasses read-only and could not merge into them."""
    hints = typing.get_type_hints(config_class)
    twin = [(f.name, _schema_of(hints[f.name]) if dataclasses.is_dataclass(hints[f.name]) else hints[f.name])
            for f in dataclasses.fields(config_class)]  # fmt: skip
    return dataclasses.make_dataclass(config_class.__name__, twin)


def _built(config_class: type, values: Any, key: str) -> Any:
    hints = typing.get_type_hints(config_class)
    arguments = {
        name: _built(hints[name], value, f"{key}{name}.") if dataclasses.is_dataclass(hints[name]) else value
        for name, value in values.items()
    }
    try:
        return config_class(**arguments)
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(key) else f"{key}{error}") from None
