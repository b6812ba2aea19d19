"""The command line: reads options, calls `rig.api`, prints. Each module holds a group of commands.

Input: the arguments of the shell. Output: text or one JSON object on stdout, messages on stderr, and an exit code. No
package that it calls prints. `main` is the program's entry. `command` has what every command shares (options, errors,
exit codes), `tables` prints results for a terminal.
"""
