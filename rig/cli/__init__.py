"""The command line: reads options, calls `rig.api`, prints. Each module holds a group of commands.

Nothing below this package prints. `main` is the program's entry. `command` has what every command shares (options,
errors, exit codes), `tables` prints results for a terminal.
"""
