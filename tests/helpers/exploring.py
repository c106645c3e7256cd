"""A whole run as a value."""

from probewise.experiment import Exploration, explore


def run(arm, experiment, *, hidden=None, **options):
    about = {"about": {"hidden": hidden.journal_entry}} if hidden is not None else {}
    return Exploration(experiment, tuple(explore(arm, experiment, **about, **options)), hidden)
