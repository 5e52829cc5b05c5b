"""`diffproj board`: a page with a board to print."""

import argparse

from diffproj.cli.inputs import check_writable, writing
from diffproj.cli.terminal import as_json, result
from diffproj.cli.which_board import given_board, kind_of
from diffproj.targets.printing import UNITS, draw_target


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    check_writable("FILE", options.file)
    board, side, option = given_board(options)
    unit = side.unit or "mm"
    if unit not in UNITS:
        raise ValueError(f"{option}: want one of the units {', '.join(UNITS)} to print in, got {side}")
    with writing("FILE", options.file):
        try:
            draw_target(board, options.file, options.paper, dpi=options.dpi, unit=unit)
        except ValueError as error:
            text = str(error)
            raise ValueError(f"--{text}" if text.startswith(("paper", "dpi")) else text) from None
    if options.json:
        told = {"file": str(options.file), "kind": kind_of(options), "board": repr(board), "paper": options.paper}
        as_json({**told, "unit": unit, "warnings": options.warned})
        return 0
    result(f"Written to {options.file}: print it at 100 %, and measure its ruler")
    return 0
