"""The command line, a file for each family of commands; only the parser is loaded before a command is known."""

from .command_line import main

__all__ = ["main"]
