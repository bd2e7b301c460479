"""Mutation testing: small faults put into the code one at a time, and whether the tests of that code notice them.

python -m studies.mutation [--module MODULE ...] [--mutants N] [--workers N] [--seed N] [--write]

A mutant is one module with one change: another operator or comparison, a number plus or minus 1, a negated condition,
or None returned. Each mutant is imported in a process of its own, which runs the tests of `TESTS` that concern the
module. The mutant is killed if a test fails or if the tests exceed `LIMIT_S`. The mutants of a module are drawn with
the seed. Annotations, decorators and error messages are not mutated. Pixel models run uncompiled.

The score is the fraction of killed mutants. Mutants that compute the same as the code, listed with the reason in
`EQUIVALENT`, count as survivors in it. --write updates section `mutation` of docs/results/reliability.json.
"""

import ast
import importlib.machinery
import itertools
import json
import multiprocessing
import os
import random
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 60.0
FIRST_LIMIT_S = 5 * LIMIT_S  # the first run of the tests also compiles kernels
UNCOMPILED = tuple(
    f"polarnet.simulation.pixels.{name}" for name in ("physics", "light", "exact", "v2e", "esim", "voltmeter")
)
"""Modules whose kernels run as Python, so that a mutant of one of them needs no compilation."""
EXACT = str(ROOT / "polarnet/simulation/pixels/exact.py")
UNSIGNED = """
mixed, key_for = ((lambda *values, made=made: np.uint64(made(*values))) for made in (mixed, key_for))
"""
"""End of the uncompiled module `exact`: random bits stay unsigned on their way through Python."""
PRELOADED = (
    "torch", "numpy", "numba", "scipy.stats", "cv2", "zarr", "hydra", "omegaconf", "pydantic.dataclasses", "beartype",
    "jaxtyping", "hypothesis", "pytest", "matplotlib.figure", "ruamel.yaml", "skimage.metrics", "torchmetrics",
)  # fmt: skip
ONE_PIXEL = (
    "test_pixel_physics or test_light or log_ramp or low_pass or delayed or response_is_linear or follows_a_step "
    "or v2e_does_not or leak_of or shot_noise_of"
)
"""Tests of the pixel models that take little time without compilation."""
TESTS: Mapping[str, tuple[str, ...]] = {
    "polarnet/stokes.py": ("tests/test_stokes.py",),
    "polarnet/simulation/polarizers.py": ("tests/simulation/test_sensor_polarizers.py",),
    "polarnet/simulation/rendering.py": ("tests/simulation/test_moving_sensor.py", "tests/simulation/test_motion.py"),
    "polarnet/simulation/pixels/physics.py": (
        "tests/simulation/test_emulator.py",
        "tests/simulation/test_pixel_physics.py",
        "-k",
        ONE_PIXEL,
    ),
    "polarnet/simulation/pixels/light.py": (
        "tests/simulation/test_emulator.py",
        "tests/simulation/test_pixel_physics.py",
        "tests/simulation/test_light.py",
        "-k",
        ONE_PIXEL,
    ),
    "polarnet/simulation/pixels/exact.py": (
        "tests/simulation/test_emulator.py",
        "tests/simulation/test_pixel_physics.py",
        "-k",
        ONE_PIXEL,
    ),
    "polarnet/metrics/similarity.py": ("tests/metrics/test_similarity.py",),
    "polarnet/metrics/scores.py": ("tests/metrics/test_scores.py",),
    "polarnet/metrics/reliability.py": ("tests/metrics/test_reliability.py",),
    "polarnet/events/windows.py": ("tests/events/test_windows.py",),
    "polarnet/events/streaming.py": ("tests/events/test_streaming.py",),
    "polarnet/events/representations.py": ("tests/events/test_representations.py",),
    "polarnet/events/mosaic.py": ("tests/events/test_mosaic.py",),
}
"""Tests that concern a module."""
EQUIVALENT: Mapping[str, str] = {
    "polarnet/stokes.py: folded = torch.where(angle < 0, angle + math.pi, angle) -> folded = "
    "torch.where(angle <= 0, angle + math.pi, angle)": "0 becomes pi, which the next line makes 0",
    "polarnet/metrics/similarity.py: return torch.where(varies, covariance / torch.where(varies, "
    "variance, 1.0).sqrt(), constant).to(dtype) -> return torch.where(varies, covariance / "
    "torch.where(varies, variance, "
    "2.0).sqrt(), constant).to(dtype)": "the quotient is not used where the frame is constant",
    "polarnet/metrics/reliability.py: here = (self.pixels > 0) & (self.measured > 0) -> here = "
    "(self.pixels > -1) & (self.measured > 0)": "a bin without pixels has no measured error",
    "polarnet/metrics/reliability.py: here = (self.pixels > 0) & (self.measured > 0) -> here = "
    "(self.pixels >= 0) & (self.measured > 0)": "a bin without pixels has no measured error",
    "polarnet/simulation/polarizers.py: pixels = "
    "channels[0].size -> pixels = channels[-1].size": "all sensors have the same size",
    "polarnet/simulation/pixels/physics.py: if "
    "sigma == 0: -> if sigma == -1:": "a deviation of 0 gives the same map without the shortcut",
    "polarnet/simulation/rendering.py: inner = (nearest > 0) & (nearest < len(even) - 1) -> inner = "
    "(nearest > 0) & (nearest < len(even) + 1)": "the last frame gets the end of the sequence anyway",
    "polarnet/simulation/rendering.py: for place in (pose.x - (width - 1) / 2, pose.y - (height - 1) / "
    "2): -> for place in (pose.x - (width - 1) / "
    "2, pose.y + "
    "(height - 1) / 2):": "the place moves by whole pixels, and so do the rows that it crosses",
    "polarnet/simulation/rendering.py: return slice(math.floor(first.min()), min(math.floor(first.max()) "
    "+ size + 1, limit)) -> return slice(math.floor(first.min()), min(math.floor(first.max()) + size + "
    "2, limit))": "the light has a row more, which no pixel sees",
    "polarnet/simulation/pixels/physics.py: if cov_decades "
    "== 0: -> if cov_decades == -1:": "a spread of 0 gives the same map without the shortcut",
    "polarnet/simulation/pixels/exact.py: beyond = (max(change, final) >= active.threshold_on[a]) | "
    "(min(change, final) <= -active.threshold_off[a]) -> beyond = (max(change, final) >= "
    "active.threshold_on[a]) | (min(change, "
    "final) > -active.threshold_off[a])": "a further round finds no crossing",
    "polarnet/events/windows.py: height, width = per_channel[0].shape[-2:] -> height, width = "
    "per_channel[-1].shape[-2:]": "all channels have the same size",
    "polarnet/events/streaming.py: if until_us - start_us <= MAX_PAUSE_US: -> if until_us + start_us <= "
    "MAX_PAUSE_US:": "the check that the shortcut leaves out gives the same answer",
}
"""Mutants that compute the same as the code, as `Mutant.name` gives them, each with the reason."""

OPERATORS: Mapping[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,), ast.LShift: (ast.RShift,), ast.RShift: (ast.LShift,),
    ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.BitXor: (ast.BitAnd,), ast.And: (ast.Or,),
    ast.Or: (ast.And,), ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.USub: (ast.UAdd,),
}  # fmt: skip
"""Operators and comparisons that take an operator's place."""


class Mutant(NamedTuple):
    """A module with one change."""

    module: str
    source: str
    before: str
    """The changed line."""
    after: str

    @property
    def name(self) -> str:
        """The module and the change."""
        return f"{self.module}: {self.before} -> {self.after}"


def edits(node: ast.AST) -> Iterator[tuple[ast.AST, str, Any]]:
    """Changes below a node of the syntax tree: (node, field, new value)."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params") or isinstance(node, ast.Raise):
            continue
        if isinstance(node, ast.keyword) and node.arg == "strict":  # an assertion
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from edits(child)
    match node:
        case ast.BinOp() | ast.BoolOp() | ast.UnaryOp() | ast.AugAssign():
            yield from ((node, "op", other()) for other in OPERATORS.get(type(node.op), ()))
        case ast.Compare():
            for place, op in enumerate(node.ops):
                for other in OPERATORS.get(type(op), ()):
                    yield node, "ops", [*node.ops[:place], other(), *node.ops[place + 1 :]]
        case ast.Constant(value=bool(value)):
            yield node, "value", not value
        case ast.Constant(value=int(value) | float(value)):
            yield from ((node, "value", value + change) for change in (1, -1))
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            yield node, "test", ast.UnaryOp(ast.Not(), test)
        case ast.Return(value=ast.AST() as value) if not isinstance(value, ast.Constant):
            yield node, "value", ast.Constant(None)


def mutants_of(module: str, number: int, seed: int) -> list[Mutant]:
    """Up to `number` mutants of a module, drawn with `seed`, in the order of the code."""
    tree = ast.parse((ROOT / module).read_text())
    before = ast.unparse(tree)
    possible = list(edits(tree))
    chosen = sorted(random.Random(f"{seed} {module}").sample(range(len(possible)), min(number, len(possible))))
    mutants = []
    for node, field, value in (possible[place] for place in chosen):
        original = getattr(node, field)
        setattr(node, field, value)
        after = ast.unparse(tree)
        setattr(node, field, original)
        lines = next(pair for pair in zip(before.splitlines(), after.splitlines(), strict=True) if pair[0] != pair[1])
        mutants.append(Mutant(module, after, *(line.strip() for line in lines)))
    return mutants


def _test(mutant: Mutant) -> None:
    """Run the tests of a mutant in this process; its status is that of pytest."""
    import numba
    import pytest

    output = os.open(os.devnull, os.O_WRONLY)
    for standard in (1, 2):
        os.dup2(output, standard)
    os.chdir(ROOT)
    if mutant.module.startswith("polarnet/simulation/pixels/"):
        njit = numba.njit

        def uncompiled(*kernels: Any, **options: Any) -> Any:
            return (
                njit(*kernels, **options)
                if kernels
                else lambda k: k if k.__module__ in UNCOMPILED else njit(**options)(k)
            )

        numba.njit = uncompiled
    file, loader = str(ROOT / mutant.module), importlib.machinery.SourceFileLoader
    get_data, path_stats = loader.get_data, loader.path_stats

    uncompiled_exact = mutant.module.startswith("polarnet/simulation/pixels/")

    def without_bytecode(self: Any, path: str) -> Any:
        if path == file or (path == EXACT and uncompiled_exact):
            raise OSError("the mutant has no bytecode file")
        return path_stats(self, path)

    loader.path_stats = without_bytecode  # type: ignore[method-assign]

    def changed(self: Any, path: str) -> bytes:
        content = mutant.source.encode() if path == file else get_data(self, path)
        return content + UNSIGNED.encode() if path == EXACT and uncompiled_exact else content

    loader.get_data = changed  # type: ignore[method-assign]
    for name in [name for name in sys.modules if name.partition(".")[0] == "polarnet"]:
        del sys.modules[name]  # pytest's type checks hook into modules that are not yet imported
    sys.path[:0] = [str(ROOT)]
    options = ["-x", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
    sys.exit(pytest.main([*options, *TESTS[mutant.module]]))


def outcome(mutant: Mutant, limit_s: float = LIMIT_S) -> str:
    """`survived`, `killed` or `timeout` of a mutant, from a process of its own."""
    process = CONTEXT.Process(target=_test, args=(mutant,))
    process.start()
    process.join(limit_s)
    if process.is_alive():
        process.kill()
        process.join()
        return "timeout"
    return "killed" if process.exitcode else "survived"


CONTEXT = multiprocessing.get_context("forkserver")


def measure(modules: list[str], number: int, seed: int, workers: int) -> dict[str, Any]:
    """Counts of each module, the survivors, and the score; RuntimeError if the tests fail without a mutation."""
    CONTEXT.set_forkserver_preload([*PRELOADED])
    os.environ["OMP_NUM_THREADS"] = "1"
    mutants = [mutant for module in modules for mutant in mutants_of(module, number, seed)]
    unchanged = [Mutant(module, (ROOT / module).read_text(), "", "") for module in modules]
    with ThreadPoolExecutor(workers) as pool:
        firsts = list(pool.map(outcome, unchanged, itertools.repeat(FIRST_LIMIT_S)))
        if failed := {each.module: how for each, how in zip(unchanged, firsts, strict=True) if how != "survived"}:
            raise RuntimeError(f"expected tests that pass without a mutation within {FIRST_LIMIT_S:g} s, got {failed}")
        outcomes = []
        for mutant, how in zip(mutants, pool.map(outcome, mutants), strict=True):
            outcomes.append(how)
            print(f"{how:8} {mutant.name}", flush=True)
    counts = {module: Counter[str]() for module in modules}
    for mutant, how in zip(mutants, outcomes, strict=True):
        counts[mutant.module].update(["mutants", how])
    survivors = [mutant.name for mutant, how in zip(mutants, outcomes, strict=True) if how == "survived"]
    return {
        "modules": {module: dict(sorted(of_module.items())) for module, of_module in counts.items()},
        "survivors": {name: EQUIVALENT.get(name, "no test notices it") for name in survivors},
        "mutants": len(mutants),
        "score": 1 - len(survivors) / len(mutants),
        "score_without_equivalent": 1
        - sum(name not in EQUIVALENT for name in survivors) / sum(m.name not in EQUIVALENT for m in mutants),
    }


def main() -> None:
    """The command line."""
    from studies.measure import arguments_of, command_line, machine_record, write_section  # imports polarnet

    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--module", nargs="+", choices=tuple(TESTS), default=[*TESTS], metavar="MODULE")
    parser.add_argument("--mutants", type=int, default=60, help="largest number for each module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    figures = measure(arguments.module, arguments.mutants, arguments.seed, arguments.workers)
    print(json.dumps(figures, indent=2))
    if arguments.write:
        print(write_section(ROOT, "reliability", "mutation", figures, record, {"mutation_score": figures["score"]}))


if __name__ == "__main__":
    main()
