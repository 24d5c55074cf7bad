"""`lgmdjax trial`: some policies in some trials, one after the other, and a line about each."""

from collections.abc import Iterator

from lgmdjax.cli.flags import TrialFlags
from lgmdjax.evaluation import run_trial
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject


def run_trials(flags: TrialFlags) -> Iterator[str]:
    """Run every policy in every trial; yield a line about each when it is done."""
    for trial in flags.trials:
        for policy in flags.policies():
            folder = run_trial.run_trial(
                trial, policy, seed=flags.seed, seeds=flags.seeds, width=flags.width, run=flags.run, out=flags.out
            )
            yield f"{trial}, {policy}: {describe(storage.read_table(folder / 'outcome.json'))}; results in {folder}"


def describe(outcome: JsonObject) -> str:
    """Return the outcome of a trial as one line.

    >>> progress = {"coverage": {"value": 18.21}}
    >>> describe({"per_100_m": {"value": 7.3}, "collisions": 3, "distance": 41.2, "progress": progress})
    '3 collisions in 41 m, 18.2 new cells a minute'
    """
    if "per_100_m" in outcome:
        coverage = outcome["progress"]["coverage"]["value"]
        return f"{outcome['collisions']} collisions in {outcome['distance']:.0f} m, {coverage:.1f} new cells a minute"
    untouched = f"{outcome['untouched']} of {outcome['robots']} untouched"
    line = f"{untouched}; {outcome['passed']} passed, {outcome['retreated']} turned back"
    return f"{line}; SPL {outcome['spl']['value']:.2f}" if "spl" in outcome else line
