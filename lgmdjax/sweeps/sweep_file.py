"""The file of a sweep: one command of lgmdjax, and the flags and seeds with which it runs.

```toml
command = ["trial", "unseen", "--seeds", "8"]  # without --out and --seed, which the sweep adds
result = "*/trial/outcome.json"                # the file of a run with its numbers, below its --out
measures = ["per_100_m.value", "progress.coverage.value"]
seeds = [0, 1, 2]

[grid]                                         # flags without their dashes; all combinations run
policy = ["learned", "blind"]
width = [80, 160]
```

Instead of `[grid]`, each `[[settings]]` is one combination. A list of words is a flag with several values, true is
`--flag`, false is `--no-flag`. A measure is a path of keys, or of numbers in lists, to a number in the result.
"""

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lgmdjax.errors import InputError, one_line

Value = str | int | float | bool | Sequence[str | int | float]
Setting = Mapping[str, Value]  # flag, without its dashes, and value
REMEDY = "see `lgmdjax sweep --help`"
MAX_RUNS = 100_000
OWN_FLAGS = ("out", "seed")  # which the sweep sets


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A command with all of its settings and seeds."""

    command: tuple[str, ...]
    result: str  # pattern of the path of the result
    measures: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: tuple[Setting, ...]

    def runs(self) -> list["SweepRun"]:
        """Return all runs: every setting with every seed."""
        numbered = itertools.product(enumerate(self.settings), self.seeds)
        return [SweepRun(command=self.command, number=number, setting=setting, seed=seed)
                for (number, setting), seed in numbered]  # fmt: skip

    def varied(self) -> tuple[str, ...]:
        """Return the flags of the settings, in the order of the file."""
        return tuple(dict.fromkeys(flag for setting in self.settings for flag in setting))


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """The command with one setting and one seed."""

    command: tuple[str, ...]
    number: int  # of the setting
    setting: Setting
    seed: int

    @property
    def name(self) -> str:
        """Name of the folder of the run."""
        return f"{self.number:04d}-seed-{self.seed}"

    def arguments(self, out: Path) -> list[str]:
        """Return the arguments of `lgmdjax`, which write into the folder `out`.

        >>> run = SweepRun(command=("train",), number=0, setting={"train.epochs": 80, "track": ""}, seed=3)
        >>> run.arguments(Path("here"))
        ['train', '--train.epochs', '80', '--track', '', '--seed', '3', '--out', 'here']
        """
        flags = [word for flag, value in self.setting.items() for word in _words(flag, value)]
        return [*self.command, *flags, "--seed", str(self.seed), "--out", str(out)]


def read(path: Path) -> Sweep:
    """Read the file of a sweep; raise `InputError` for one that is missing or wrong."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"expected a sweep in TOML, got {path} ({one_line(error)}); {REMEDY}") from error
    unknown = content.keys() - {"command", "result", "measures", "seeds", "grid", "settings"}
    if unknown:
        raise InputError(f"{path}: expected command, result, measures, seeds and grid or settings, "
                         f"got {', '.join(sorted(unknown))}; {REMEDY}")  # fmt: skip
    command, measures = (tuple(_list(path, content, name, str)) for name in ("command", "measures"))
    seeds, settings = tuple(_list(path, content, "seeds", int)), _settings(path, content)
    result = content.get("result")
    if not isinstance(result, str) or not result or Path(result).is_absolute() or ".." in Path(result).parts:
        raise InputError(f"{path}: expected in result the path of a JSON file below --out, got {result!r}; {REMEDY}")
    sweep = Sweep(command=command, result=result, measures=measures, seeds=seeds, settings=settings)
    _check(path, sweep)
    return sweep


def _words(flag: str, value: Value) -> list[str]:
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    values = [value] if isinstance(value, (str, int, float)) else value
    return [f"--{flag}", *map(str, values)]


def _list(path: Path, content: Mapping[str, object], name: str, kind: type) -> list:
    """Return a list of values of one type, none of them twice."""
    values = content.get(name)
    if not isinstance(values, list) or not values or any(type(value) is not kind for value in values):
        raise InputError(f"{path}: expected in {name} a list of {kind.__name__}, got {values!r}; {REMEDY}")
    if name != "command" and len(set(values)) < len(values):
        raise InputError(f"{path}: expected each of {name} once, got {values}; leave out what is there twice")
    return values


def _settings(path: Path, content: Mapping[str, object]) -> tuple[Setting, ...]:
    """Return the settings of `[grid]` or `[[settings]]`; one without flags if there is neither."""
    grid, listed = content.get("grid"), content.get("settings")
    if grid is not None and listed is not None:
        raise InputError(f"{path}: expected either [grid] or [[settings]], got both; {REMEDY}")
    if grid is None:
        settings = listed if listed is not None else [{}]
        if not isinstance(settings, list) or not settings or not all(isinstance(each, dict) for each in settings):
            raise InputError(f"{path}: expected tables in [[settings]], got {settings!r}; {REMEDY}")
        return tuple(settings)
    if not isinstance(grid, dict) or not all(isinstance(values, list) and values for values in grid.values()):
        raise InputError(f"{path}: expected in [grid] a list of values for each flag, got {grid!r}; {REMEDY}")
    return tuple(dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values()))


def _check(path: Path, sweep: Sweep) -> None:
    """Raise `InputError` for flags, values, seeds or sizes that cannot be."""
    given = [flag for setting in sweep.settings for flag in setting]
    given += [word[2:].partition("=")[0] for word in sweep.command if word.startswith("--")]
    for flag in given:
        if flag in OWN_FLAGS or not flag or flag.startswith("-"):
            raise InputError(f"{path}: expected flags without dashes, and neither out nor seed, got {flag!r}; {REMEDY}")
    for value in (value for setting in sweep.settings for value in setting.values()):
        parts = value if isinstance(value, list) else [value]
        if not all(isinstance(part, (str, int, float)) for part in parts):
            raise InputError(f"{path}: expected text, numbers or booleans as values of flags, got {value!r}; {REMEDY}")
    if min(sweep.seeds) < 0:
        raise InputError(f"{path}: expected seeds of 0 or more, got {min(sweep.seeds)}; choose others")
    if len(sweep.settings) * len(sweep.seeds) > MAX_RUNS:
        raise InputError(f"{path}: expected at most {MAX_RUNS} runs, got {len(sweep.settings) * len(sweep.seeds)}")
