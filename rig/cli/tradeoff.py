"""The command that finds what accuracy costs in time, and which setting to use: `rig tradeoff`."""

from rig.cli.command import EXIT_ABORTED, Commands, ConfigArgument, JsonOption, api, asks, print_json, say
from rig.cli.progress import progress
from rig.requests import TradeoffRequest


@asks(TradeoffRequest)
def tradeoff_command(
    request: TradeoffRequest, config: ConfigArgument = "simulated", as_json: JsonOption = False
) -> int:
    """Scan a simulated rig with many settings: error over sensor time and compute time, and which setting to use."""
    with progress():
        done = api.tradeoff(config, request)
    if as_json:
        print_json(done.as_json())
    else:
        from rig.cli.tables import tradeoff_table

        tradeoff_table(done)
    if done.verdict == "aborted":
        say("aborted: these are the rows that were whole by then")
        return EXIT_ABORTED
    if done.wish is None:
        return 0
    if done.answer is None:
        say(f"error: every setting leaves more than 5 % of the answers out, so that none can be named for {done.wish}; "
            "raise --exposures")  # fmt: skip
        return 1
    return 0 if done.answer.fits else 1


COMMANDS: Commands = {"tradeoff": tradeoff_command}
