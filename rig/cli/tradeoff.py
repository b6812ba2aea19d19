"""The command that finds what accuracy costs in time, and which setting to use: `rig tradeoff`."""

from rig.cli.command import EXIT_ABORTED, Answer, Commands, ConfigArgument, api, asks, tables
from rig.cli.progress import progress
from rig.requests import TradeoffRequest


@asks(TradeoffRequest)
def tradeoff_command(request: TradeoffRequest, config: ConfigArgument = "simulated") -> Answer:
    """Scan a simulated rig with many settings: error over sensor time and compute time, and which setting to use."""
    with progress():
        done = api.tradeoff(config, request)
    code, note = 0 if done.wish is None or (done.answer is not None and done.answer.fits) else 1, ""
    if done.verdict == "aborted":
        code, note = EXIT_ABORTED, "aborted: these are the rows that were whole by then"
    elif done.wish is not None and done.answer is None:
        note = (
            f"error: every setting leaves more than 5 % of the answers out, so that none can be named for {done.wish}; "
            "raise --exposures"
        )
    return Answer(done.as_json(), lambda: tables.tradeoff_table(done), code, note)


COMMANDS: Commands = {"tradeoff": tradeoff_command}
