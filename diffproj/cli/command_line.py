"""The parser of command lines: what it cannot write is a failure, and a misspelt option is told from the right ones."""

import argparse
import difflib
import itertools
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn


class CommandLine(argparse.ArgumentParser):
    """argparse's parser, which passes over a help that could not be written, and only names what it does not know."""

    def _print_message(self, message: str, file: Any = None) -> None:
        """Write, and raise `OSError` where standard output takes no more."""
        if file is not None and file is sys.stdout:
            file.write(message)
            file.flush()
        else:
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        """End with a mistake, said as failures are: after how the command is used, the argument and what it wants."""
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}\n")

    def refuse(self, unknown: Sequence[str], given: Sequence[str]) -> NoReturn:
        """End with the mistake that these of the given arguments are unknown, and with the options that are meant."""
        texts = [text.strip() for text in unknown]
        flags = {
            option: action.help for action in self._actions if action.nargs == 0 for option in action.option_strings
        }
        for option, value in itertools.pairwise(given):
            if option in flags and value in texts and not value.startswith("-"):  # that is an option, misspelt
                self.error(f"{option}: takes no value, got {value!r}; it means: {flags[option]}")
        known = [option for action in self._actions for option in action.option_strings if option.startswith("--")]
        meant = {text: difflib.get_close_matches(text.partition("=")[0], known, 1) for text in texts}
        alike = list(dict.fromkeys(option for options in meant.values() for option in options))
        remedy = f"did you mean {' and '.join(alike)}?" if alike else f"'{self.prog} --help' lists the options"
        self.error(f"unrecognized arguments: {' '.join(texts)}; {remedy}")


def leave_output() -> None:
    """Let what is still to be written go nowhere, or Python would complain of it once more at its end."""
    try:
        output = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # no file: in a notebook, or in a test
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, output)
    os.close(nowhere)
