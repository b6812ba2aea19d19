"""The command line: reads options, calls `rig.api`, prints. Each module holds a group of commands.

No package below this one prints anything or knows the name of an option. `main` is the program's entry, `command` what
every command shares (options, errors, exit codes), `tables` how results look in a terminal.
"""
